//! Radial distortion of a lens: from ideal image points to those on the sensor, and back.

/// Radial distortion about the middle of an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Distortion {
    coefficient: f64,
    middle: [f64; 2],
    /// One over the square of half the image diagonal, 1/pixel^2.
    inverse_square: f64,
}

impl Distortion {
    pub(super) fn new(coefficient: f64, width: usize, height: usize) -> Self {
        let (width, height) = (width as f64, height as f64);
        Self {
            coefficient,
            middle: [0.5 * width, 0.5 * height],
            inverse_square: 4.0 / (width * width + height * height),
        }
    }

    /// True when straight lines stay straight.
    pub(super) fn is_none(&self) -> bool {
        self.coefficient == 0.0
    }

    /// Where the lens puts an ideal image point.
    pub(super) fn distort(&self, ideal: [f64; 2]) -> [f64; 2] {
        if self.is_none() {
            return ideal;
        }
        let [x, y] = self.offset(ideal);
        let factor = 1.0 + self.coefficient * (x * x + y * y) * self.inverse_square;
        [self.middle[0] + x * factor, self.middle[1] + y * factor]
    }

    /// The ideal image point that the lens puts here: `r (1 + k r^2) = seen` by Newton's method; NaN where the lens puts
    /// none (beyond its fold, for a barrel of more than a third).
    pub(super) fn undistort(&self, seen: [f64; 2]) -> [f64; 2] {
        if self.is_none() {
            return seen;
        }
        let [x, y] = self.offset(seen);
        let wanted = ((x * x + y * y) * self.inverse_square).sqrt();
        let ratio = match wanted > 0.0 {
            true => self.ideal_radius(wanted) / wanted,
            false => 1.0,
        };
        [self.middle[0] + x * ratio, self.middle[1] + y * ratio]
    }

    fn ideal_radius(&self, seen: f64) -> f64 {
        let k = self.coefficient;
        let mut r = seen;
        for _ in 0..STEPS {
            let slope = 1.0 + 3.0 * k * r * r;
            if slope.is_nan() || slope <= 0.0 {
                return f64::NAN;
            }
            let step = (r * (1.0 + k * r * r) - seen) / slope;
            r -= step;
            if step.abs() <= 4.0 * f64::EPSILON * r {
                return r;
            }
        }
        f64::NAN
    }

    fn offset(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [x - self.middle[0], y - self.middle[1]]
    }
}

/// Newton's steps: it converges in 3 to 6 for every lens that has an inverse.
const STEPS: usize = 60;
