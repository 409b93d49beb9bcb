//! The ray test: eight capsules at a time, the same arithmetic on every lane and on every processor path.

/// Capsules tested at once: one AVX2 register of f32.
pub(super) const LANES: usize = 8;

/// "No capsule".
pub(super) const NO_CAPSULE: u32 = u32::MAX;

/// One capsule of the cell in half a cache line: middle, radius, half axis (middle to end), and its own index as bits.
#[derive(Debug, Clone, Copy)]
#[repr(align(32))]
pub(super) struct Capsule([f32; 8]);

impl Capsule {
    pub(super) fn new(middle: [f32; 3], radius: f32, half: [f32; 3], index: u32) -> Self {
        let ([x, y, z], [u, v, w]) = (middle, half);
        Self([x, y, z, radius, u, v, w, f32::from_bits(index)])
    }

    pub(super) fn middle(&self) -> [f32; 3] {
        [self.0[0], self.0[1], self.0[2]]
    }

    pub(super) fn radius(&self) -> f32 {
        self.0[3]
    }

    pub(super) fn half(&self) -> [f32; 3] {
        [self.0[4], self.0[5], self.0[6]]
    }
}

/// A ray inside one periodic cell, in the cell's coordinates; `direction` is a unit vector, `end` its length.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ray {
    pub(super) origin: [f32; 3],
    pub(super) direction: [f32; 3],
    pub(super) end: f32,
}

/// The nearest entries found so far, one per lane. Lanes are compared only at the end, so that a ray has no branch that
/// waits for the outcome of a test.
pub(super) struct Nearest {
    distance: [f32; LANES],
    capsule: [u32; LANES],
}

impl Nearest {
    #[inline(always)]
    pub(super) fn new(end: f32) -> Self {
        Self {
            distance: [end; LANES],
            capsule: [NO_CAPSULE; LANES],
        }
    }

    /// The nearest entry of all lanes, or the ray's end.
    #[inline(always)]
    pub(super) fn distance(&self) -> f32 {
        // Distances are not negative, so their bits are ordered as they are; integers have a vector minimum.
        let mut least = u32::MAX;
        for t in self.distance {
            least = least.min(t.to_bits());
        }
        f32::from_bits(least)
    }

    /// The capsule entered at `distance`; the smallest index where several are entered there.
    #[inline(always)]
    pub(super) fn capsule(&self, distance: f32) -> u32 {
        let at = distance.to_bits();
        let mut found = NO_CAPSULE;
        for l in 0..LANES {
            let here = self.distance[l].to_bits() == at;
            found = found.min(if here { self.capsule[l] } else { NO_CAPSULE });
        }
        found
    }

    /// Tests the first `count` of the eight capsules named by `list`, except those in `skip`.
    ///
    /// A capsule counts where the ray enters it, at a distance from 0 to the nearest so far; not when the ray starts inside
    /// or points away. With the ray's point g nearest to the capsule's middle as origin, the half axis u and n = d x u, the
    /// ray meets the infinite cylinder where `n.n t^2 + 2 n.(g x u) t + ... = 0`, whose discriminant is
    /// `u.u (r^2 n.n - (g.n)^2)`: nothing large cancels, neither for long thin capsules nor for rays along them. `FUSED`
    /// fuses multiplications and additions, for processors that do so in hardware.
    #[inline(always)]
    pub(super) fn test<const FUSED: bool>(
        &mut self,
        ray: &Ray,
        capsules: &[Capsule],
        list: &[u32; LANES],
        count: usize,
        skip: [u32; 3],
    ) {
        let lanes = gather(capsules, list);
        let [ox, oy, oz] = ray.origin;
        let [dx, dy, dz] = ray.direction;
        let d = [dx, dy, dz];
        for l in 0..LANES {
            let [ux, uy, uz] = [lanes[4][l], lanes[5][l], lanes[6][l]];
            let u = [ux, uy, uz];
            let radius2 = lanes[3][l] * lanes[3][l];
            let [wx, wy, wz] = [ox - lanes[0][l], oy - lanes[1][l], oz - lanes[2][l]];
            let shift = -dot::<FUSED>([wx, wy, wz], d);
            let [gx, gy, gz] = [
                fused::<FUSED>(dx, shift, wx),
                fused::<FUSED>(dy, shift, wy),
                fused::<FUSED>(dz, shift, wz),
            ];
            let g = [gx, gy, gz];

            // The infinite cylinder.
            let n = cross::<FUSED>(d, u);
            let (a, b) = (dot::<FUSED>(n, n), dot::<FUSED>(n, cross::<FUSED>(g, u)));
            let (length2, along, apart) =
                (dot::<FUSED>(u, u), dot::<FUSED>(d, u), dot::<FUSED>(g, n));
            let h = fused::<FUSED>(a, radius2, -(apart * apart));
            // For a == 0 (parallel ray) this is not finite and the comparisons below choose the facing cap.
            let t = (-b - (length2 * h).sqrt()) / a;
            let y = fused::<FUSED>(t, along, dot::<FUSED>(g, u));
            let on_body = (y > -length2) & (y < length2);

            // The sphere of the cap on that side; the squared distance of its center from the line, without cancellation.
            let at_start = if a > 0.0 { y <= 0.0 } else { along > 0.0 };
            let [cx, cy, cz] = [
                if at_start { gx + ux } else { gx - ux },
                if at_start { gy + uy } else { gy - uy },
                if at_start { gz + uz } else { gz - uz },
            ];
            let b = dot::<FUSED>(d, [cx, cy, cz]);
            let aside = [
                fused::<FUSED>(-dx, b, cx),
                fused::<FUSED>(-dy, b, cy),
                fused::<FUSED>(-dz, b, cz),
            ];
            let cap = -b - (radius2 - dot::<FUSED>(aside, aside)).sqrt();

            // A missed cap is NaN, which no comparison passes.
            let distance = if on_body { t } else { cap } + shift;
            let index = lanes[7][l].to_bits();
            let seen = (l < count) & (index != skip[0]) & (index != skip[1]) & (index != skip[2]);
            let nearer = (h >= 0.0) & (distance >= 0.0) & (distance < self.distance[l]) & seen;
            self.distance[l] = if nearer { distance } else { self.distance[l] };
            self.capsule[l] = if nearer { index } else { self.capsule[l] };
        }
    }
}

#[inline(always)]
pub(super) fn fused<const FUSED: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FUSED { a.mul_add(b, c) } else { a * b + c }
}

#[inline(always)]
fn dot<const FUSED: bool>([ax, ay, az]: [f32; 3], [bx, by, bz]: [f32; 3]) -> f32 {
    fused::<FUSED>(ax, bx, fused::<FUSED>(ay, by, az * bz))
}

#[inline(always)]
fn cross<const FUSED: bool>([ax, ay, az]: [f32; 3], [bx, by, bz]: [f32; 3]) -> [f32; 3] {
    [
        fused::<FUSED>(ay, bz, -(az * by)),
        fused::<FUSED>(az, bx, -(ax * bz)),
        fused::<FUSED>(ax, by, -(ay * bx)),
    ]
}

/// Eight capsules, one quantity after the other.
#[inline(always)]
fn gather(capsules: &[Capsule], list: &[u32; LANES]) -> [[f32; LANES]; 8] {
    let mut lanes = [[0.0; LANES]; 8];
    for l in 0..LANES {
        let row = &capsules[list[l] as usize].0;
        for k in 0..8 {
            lanes[k][l] = row[k];
        }
    }
    lanes
}
