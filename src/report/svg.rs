//! A small drawing surface with two axes.

use super::html::{escape, number};

/// How an axis maps values to the surface.
#[derive(Debug, Clone, Copy)]
pub(super) enum Scale {
    Linear,
    Logarithmic,
}

/// One axis: its values from `low` to `high` are drawn between the surface's `from` and `to`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Axis {
    pub(super) scale: Scale,
    pub(super) low: f64,
    pub(super) high: f64,
    pub(super) from: f64,
    pub(super) to: f64,
}

impl Axis {
    /// Where `value` is drawn; values outside the axis land on its ends.
    pub(super) fn at(&self, value: f64) -> f64 {
        let t = match self.scale {
            Scale::Linear => (value - self.low) / (self.high - self.low),
            Scale::Logarithmic => (value.max(1e-300) / self.low).ln() / (self.high / self.low).ln(),
        };
        self.from + t.clamp(0.0, 1.0) * (self.to - self.from)
    }

    /// Round values to label.
    pub(super) fn ticks(&self) -> Vec<f64> {
        match self.scale {
            Scale::Linear => {
                let raw = (self.high - self.low) / 5.0;
                let decade = 10_f64.powf(raw.log10().floor());
                let step = [1.0, 2.0, 5.0, 10.0]
                    .into_iter()
                    .map(|m| m * decade)
                    .find(|s| *s >= raw * 0.999)
                    .unwrap_or(raw);
                let first = (self.low / step).ceil() as i64;
                let last = (self.high / step + 1e-9).floor() as i64;
                (first..=last).map(|k| k as f64 * step).collect()
            }
            Scale::Logarithmic => {
                let decades = (self.high / self.low).log10();
                let steps: &[f64] = match decades {
                    d if d < 1.5 => &[1.0, 2.0, 5.0],
                    d if d < 2.5 => &[1.0, 3.0],
                    _ => &[1.0],
                };
                let (first, last) = (
                    self.low.log10().floor() as i32,
                    self.high.log10().ceil() as i32,
                );
                (first..=last)
                    .flat_map(|k| steps.iter().map(move |s| s * 10_f64.powi(k)))
                    .filter(|v| (self.low * 0.999..=self.high * 1.001).contains(v))
                    .collect()
            }
        }
    }
}

/// A logarithmic range around positive values, a little wider than they are; `(0.1, 1)` when there are none.
pub(super) fn log_range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values
        .filter(|v| *v > 0.0 && v.is_finite())
        .fold((f64::INFINITY, 0.0_f64), |(l, h), v| (l.min(v), h.max(v)));
    if low > high {
        return (0.1, 1.0);
    }
    (low / 1.3, high * 1.3)
}

/// An SVG picture under construction, `width` x `height` user units; scales to the page.
pub(super) struct Drawing {
    width: f64,
    height: f64,
    label: String,
    body: String,
}

impl Drawing {
    /// An empty drawing; `label` says to a screen reader what it shows.
    pub(super) fn new(width: f64, height: f64, label: &str) -> Self {
        Self {
            width,
            height,
            label: escape(label),
            body: String::new(),
        }
    }

    pub(super) fn line(&mut self, class: &str, x1: f64, y1: f64, x2: f64, y2: f64) {
        self.raw(&format!(
            "<line class=\"{class}\" x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\"/>"
        ));
    }

    pub(super) fn rectangle(&mut self, class: &str, x: f64, y: f64, width: f64, height: f64) {
        self.raw(&format!(
            "<rect class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\" width=\"{width:.1}\" height=\"{height:.1}\"/>"
        ));
    }

    /// Text; `anchor` is start, middle or end.
    pub(super) fn text(&mut self, class: &str, x: f64, y: f64, anchor: &str, text: &str) {
        let text = escape(text);
        self.raw(&format!(
            "<text class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{text}</text>"
        ));
    }

    pub(super) fn polyline(&mut self, class: &str, points: &[(f64, f64)]) {
        let list: Vec<String> = points
            .iter()
            .map(|(x, y)| format!("{x:.1},{y:.1}"))
            .collect();
        self.raw(&format!(
            "<polyline class=\"{class}\" points=\"{}\"/>",
            list.join(" ")
        ));
    }

    /// The mark of a channel: red disk, green square, blue triangle; `title` appears when pointed at.
    pub(super) fn mark(&mut self, channel: usize, x: f64, y: f64, title: &str) {
        let title = format!("<title>{}</title>", escape(title));
        let shape = match channel {
            0 => format!(
                "<circle class=\"m0\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3.2\">{title}</circle>"
            ),
            1 => format!(
                "<rect class=\"m1\" x=\"{:.1}\" y=\"{:.1}\" width=\"5.6\" height=\"5.6\">{title}</rect>",
                x - 2.8,
                y - 2.8
            ),
            _ => format!(
                "<path class=\"m2\" d=\"M{x:.1} {:.1}l3.6 6.2h-7.2z\">{title}</path>",
                y - 3.8
            ),
        };
        self.raw(&shape);
    }

    /// A disk with a title.
    pub(super) fn disk(&mut self, class: &str, x: f64, y: f64, radius: f64, title: &str) {
        self.raw(&format!(
            "<circle class=\"{class}\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius:.1}\"><title>{}</title></circle>",
            escape(title)
        ));
    }

    /// Frame, grid lines and labels of both axes; `unit` follows the numbers of y.
    pub(super) fn axes(&mut self, x: &Axis, y: &Axis, x_name: &str, y_name: &str) {
        let (left, right) = (x.from.min(x.to), x.from.max(x.to));
        let (top, bottom) = (y.from.min(y.to), y.from.max(y.to));
        for v in x.ticks() {
            self.line("grid", x.at(v), top, x.at(v), bottom);
            self.text("tick", x.at(v), bottom + 14.0, "middle", &short(v));
        }
        for v in y.ticks() {
            self.line("grid", left, y.at(v), right, y.at(v));
            self.text("tick", left - 5.0, y.at(v) + 3.5, "end", &short(v));
        }
        self.rectangle("frame", left, top, right - left, bottom - top);
        self.text(
            "name",
            0.5 * (left + right),
            bottom + 31.0,
            "middle",
            x_name,
        );
        self.text("name", left, top - 8.0, "start", y_name);
    }

    pub(super) fn raw(&mut self, element: &str) {
        self.body.push_str(element);
        self.body.push('\n');
    }

    /// The picture as part of a page.
    pub(super) fn finish(self) -> String {
        let body = &self.body;
        self.element("", body)
    }

    /// The picture as a file of its own, with the page's style inside.
    pub(super) fn finish_file(self, style: &str) -> String {
        let body = format!("<style><![CDATA[\n{style}]]></style>\n{}", self.body);
        self.element(
            " xmlns=\"http://www.w3.org/2000/svg\" font-family=\"system-ui,sans-serif\"",
            &body,
        )
    }

    fn element(&self, attributes: &str, body: &str) -> String {
        let (w, h) = (self.width, self.height);
        format!(
            "<svg{attributes} viewBox=\"0 0 {w} {h}\" role=\"img\" aria-label=\"{}\">\n{body}</svg>\n",
            self.label
        )
    }
}

/// A tick's label: thousands and millions abbreviated.
fn short(v: f64) -> String {
    match v.abs() {
        a if a >= 1e6 => format!("{} M", number(v / 1e6, 1)),
        a if a >= 1e4 => format!("{} k", number(v / 1e3, 1)),
        a if a >= 10.0 => format!("{v:.0}"),
        _ => {
            let text = format!("{v:.6}");
            let text = text.trim_end_matches('0').trim_end_matches('.');
            if text == "-0" {
                "0".to_owned()
            } else {
                text.to_owned()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        let axis = |scale, low, high| Axis {
            scale,
            low,
            high,
            from: 0.0,
            to: 100.0,
        };
        assert_eq!(
            axis(Scale::Linear, -12.0, 11.0).ticks(),
            [-10.0, -5.0, 0.0, 5.0, 10.0]
        );
        let labels: Vec<String> = axis(Scale::Logarithmic, 0.02, 3e6)
            .ticks()
            .into_iter()
            .map(short)
            .collect();
        assert_eq!(
            labels,
            ["0.1", "1", "10", "100", "1000", "10 k", "100 k", "1 M"]
        );
        let a = axis(Scale::Logarithmic, 1.0, 100.0);
        assert!(
            (a.at(10.0) - 50.0).abs() < 1e-9
                && a.at(-3.0).abs() < 1e-9
                && (a.at(1e9) - 100.0).abs() < 1e-9
        );
    }
}
