//! Predicted against measured means, channel by channel.

use super::charts::CHANNELS;
use super::html::number;
use super::page::STYLE;
use super::svg::{Axis, Drawing, Scale, log_range};
use crate::fit::{Compared, Comparison};

/// Width of one channel's panel.
const PANEL: f64 = 320.0;
const HEIGHT: f64 = 340.0;

/// An SVG file: a panel per channel, both axes logarithmic, bars of one standard error (horizontal: of the measurement;
/// vertical: of the prediction, all its errors together), as Khungurn 2015 Figures 19 and 20 compare.
pub fn prediction_chart(comparison: &Comparison) -> String {
    let mut d = Drawing::new(
        3.0 * PANEL,
        HEIGHT,
        "Predicted against measured intensities",
    );
    let values = |r: &Compared| {
        let both = [r.measured.mean, r.prediction.mean].map(|of| r.measured.where_present(of));
        both.into_iter().flatten().flatten()
    };
    let (low, high) = log_range(comparison.rows.iter().flat_map(values));
    for k in 0..3 {
        let left = PANEL * k as f64;
        let axis = |from: f64, to: f64| Axis {
            scale: Scale::Logarithmic,
            low,
            high,
            from,
            to,
        };
        let (x, y) = (
            axis(left + 52.0, left + PANEL - 10.0),
            axis(HEIGHT - 48.0, 24.0),
        );
        let name = format!("predicted, {}", CHANNELS[k]);
        d.axes(&x, &y, "measured normalized radiance", &name);
        d.line("identity", x.at(low), y.at(low), x.at(high), y.at(high));
        for row in comparison.rows.iter().filter(|r| r.measured.present[k]) {
            point(&mut d, row, k, &x, &y);
        }
    }
    d.finish_file(STYLE)
}

fn point(d: &mut Drawing, row: &Compared, k: usize, x: &Axis, y: &Axis) {
    let (m, m_se) = (row.measured.mean[k], row.measured.standard_error[k]);
    let (p, p_se) = (row.prediction.mean[k], row.prediction.standard_error()[k]);
    let bar = format!("bar c{k}");
    d.line(&bar, x.at(m - m_se), y.at(p), x.at(m + m_se), y.at(p));
    d.line(&bar, x.at(m), y.at(p - p_se), x.at(m), y.at(p + p_se));
    let title = format!(
        "configuration {}, {}: measured {} ± {}, predicted {} ± {}",
        row.measured.configuration.id,
        CHANNELS[k],
        number(m, 3),
        number(m_se, 2),
        number(p, 3),
        number(p_se, 2)
    );
    d.mark(k, x.at(m), y.at(p), &title);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::Prediction;
    use crate::session::{Configuration, Intensity};

    #[test]
    fn every_number_has_a_mark_with_both_values() {
        let configuration = Configuration::from_degrees(7, [30.0, 0.0], [40.0, 90.0], 0.0).unwrap();
        let row = Compared {
            prediction: Prediction {
                configuration,
                mean: [0.1, 0.2, 0.3],
                parameter_se: [0.003; 3],
                monte_carlo_se: [0.004; 3],
                model_se: [0.0; 3],
                renders: [[0.1, 0.2, 0.3]; 2],
                in_fit: false,
                paths: 1,
            },
            measured: Intensity {
                configuration,
                mean: [0.11, 0.21, 0.31],
                standard_error: [0.01; 3],
                present: [true; 3],
            },
            residual: [Some(-0.01); 3],
            z: [Some(-0.9); 3],
        };
        let svg = prediction_chart(&Comparison {
            rows: vec![row],
            weighted_rms_percent: [5.0, 1.0],
            rms_z: 0.9,
        });
        assert!(
            svg.starts_with("<svg xmlns=\"http://www.w3.org/2000/svg\""),
            "{svg}"
        );
        for (class, text) in [
            (
                "m0",
                "red: measured 0.110 ± 0.010, predicted 0.100 ± 0.0050",
            ),
            (
                "m1",
                "green: measured 0.210 ± 0.010, predicted 0.200 ± 0.0050",
            ),
            (
                "m2",
                "blue: measured 0.310 ± 0.010, predicted 0.300 ± 0.0050",
            ),
        ] {
            assert!(svg.contains(&format!("class=\"{class}\"")), "{svg}");
            assert!(svg.contains(text), "{svg}");
        }
    }
}
