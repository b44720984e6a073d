//! Timelines in SVG, and text in HTML.

mod layout;
mod text;

use std::fmt::Write as _;
use std::time::Duration;

pub use layout::{BELOW_OVERVIEW, Layout, NARROW, WIDE};
pub use text::{escape, shorten};

/// The styles of pages with timelines.
pub const STYLE: &str = include_str!("report/style.css");

/// Patterns that distinguish states without colour.
pub const PATTERNS: &str = "<svg class=\"defs\" width=\"0\" height=\"0\" aria-hidden=\"true\"><defs>\
<pattern id=\"hatch\" width=\"6\" height=\"6\" patternUnits=\"userSpaceOnUse\" patternTransform=\"rotate(45)\">\
<line class=\"hatch\" x1=\"0\" y1=\"0\" x2=\"0\" y2=\"6\"/></pattern>\
<pattern id=\"dots\" width=\"5\" height=\"5\" patternUnits=\"userSpaceOnUse\">\
<circle class=\"dot\" cx=\"1.5\" cy=\"1.5\" r=\"1.2\"/></pattern></defs></svg>\n";

/// Maps times to x coordinates.
#[derive(Debug)]
pub struct Axis {
    pub(crate) from: Duration,
    pub(crate) to: Duration,
    left: f64,
    right: f64,
}

impl Axis {
    /// From one time to another, between these x coordinates.
    #[must_use]
    pub fn new(from: Duration, to: Duration, left: f64, right: f64) -> Self {
        // An empty period is still drawn.
        let to = to.max(from + Duration::from_millis(1));
        Self {
            from,
            to,
            left,
            right,
        }
    }

    /// The x coordinate of a time; that of an end for a time outside.
    #[must_use]
    pub fn x(&self, at: Duration) -> f64 {
        let at = at.clamp(self.from, self.to).saturating_sub(self.from);
        let part = at.as_secs_f64() / self.to.saturating_sub(self.from).as_secs_f64();
        self.left + part * (self.right - self.left)
    }

    /// Whether a period is at least partly shown.
    #[must_use]
    pub fn shows(&self, from: Duration, to: Duration) -> bool {
        to >= self.from && from <= self.to
    }
}

/// A drawing, in SVG.
#[derive(Debug)]
pub struct Drawing {
    pub(crate) layout: &'static Layout,
    /// What is drawn so far.
    pub out: String,
    /// Its height, in units of the drawing.
    pub height: f64,
}

impl Drawing {
    /// An empty drawing.
    #[must_use]
    pub fn new(layout: &'static Layout) -> Self {
        Self {
            layout,
            out: String::new(),
            height: 0.0,
        }
    }

    /// A rectangle; `data` are attributes that say what it stands for.
    pub fn bar(&mut self, class: &str, x: (f64, f64), y: (f64, f64), data: &str, title: &str) {
        let width = (x.1 - x.0).max(1.5);
        let _ = write!(
            self.out,
            "<rect class=\"{class}\" x=\"{:.2}\" y=\"{:.1}\" width=\"{width:.2}\" height=\"{:.1}\"{data}>",
            x.0,
            y.0,
            y.1 - y.0,
        );
        let _ = writeln!(self.out, "<title>{}</title></rect>", escape(title));
    }

    /// Text.
    pub fn text(&mut self, class: &str, x: f64, y: f64, text: &str) {
        let text = escape(text);
        let _ = writeln!(
            self.out,
            "<text class=\"{class}\" x=\"{x:.1}\" y=\"{y:.1}\">{text}</text>"
        );
    }

    /// Text shortened to a width, with the whole text as its tooltip. The end of unusually wide text is
    /// clipped.
    pub fn cut(&mut self, class: &str, x: f64, y: f64, text: &str, width: f64) {
        // Names of steps are bold.
        let letter = if class == "name step" { 7.8 } else { 6.6 };
        let most = (width / letter).max(1.0) as usize;
        let (short, whole) = (escape(&shorten(text, most)), escape(text));
        let _ = writeln!(
            self.out,
            "<svg x=\"{x:.1}\" y=\"{:.1}\" width=\"{width:.1}\" height=\"20\"><text class=\"{class}\" y=\"14\">{short}<title>{whole}</title></text></svg>",
            y - 14.0
        );
    }

    /// A line.
    pub fn line(&mut self, class: &str, from: (f64, f64), to: (f64, f64)) {
        let ((x1, y1), (x2, y2)) = (from, to);
        let _ = writeln!(
            self.out,
            "<line class=\"{class}\" x1=\"{x1:.2}\" y1=\"{y1:.1}\" x2=\"{x2:.2}\" y2=\"{y2:.1}\"/>"
        );
    }

    /// The drawing, as an element of HTML.
    #[must_use]
    pub fn end(self, label: &str) -> String {
        format!(
            "<svg class=\"timeline {}\" viewBox=\"0 0 {} {:.0}\" role=\"img\" aria-label=\"{}\">\n{}</svg>\n",
            self.layout.class,
            self.layout.width,
            self.height,
            escape(label),
            self.out
        )
    }

    /// Lines for round times, and the times above them.
    pub fn scale(&mut self, axis: &Axis, top: f64, bottom: f64) {
        let length = axis.to.saturating_sub(axis.from).as_secs_f64();
        let step = round_step(length / self.layout.ticks);
        let mut tick = (axis.from.as_secs_f64() / step).ceil();
        while tick * step <= axis.to.as_secs_f64() + step * 1e-6 {
            let at = tick * step;
            let x = axis.x(Duration::try_from_secs_f64(at).unwrap_or_default());
            self.line("grid", (x, top + 14.0), (x, bottom));
            self.text("tick", x, top + 10.0, &clock(at, step));
            tick += 1.0;
        }
    }
}

/// The round number of seconds that is not below this one.
fn round_step(seconds: f64) -> f64 {
    const MINUTES: [f64; 9] = [
        60.0, 120.0, 300.0, 600.0, 1200.0, 1800.0, 3600.0, 7200.0, 14400.0,
    ];
    if seconds > 30.0 {
        let fits = MINUTES.into_iter().find(|step| *step >= seconds);
        return fits.unwrap_or_else(|| (seconds / 14400.0).ceil() * 14400.0);
    }
    let mut unit = 0.001;
    loop {
        for factor in [1.0, 2.0, 5.0] {
            if unit * factor >= seconds {
                // Nothing between 10 s and a minute divides minutes as 15 and 30 do.
                return match unit * factor {
                    step if step > 25.0 => 30.0,
                    step if step > 15.0 => 15.0,
                    step => step,
                };
            }
        }
        unit *= 10.0;
    }
}

fn clock(at: f64, step: f64) -> String {
    let whole = at.round() as u64;
    match (step < 1.0, whole) {
        (true, _) => {
            let digits = if step < 0.01 {
                3
            } else if step < 0.1 {
                2
            } else {
                1
            };
            format!("{at:.digits$} s")
        }
        (false, 0..120) if step < 60.0 => format!("{whole} s"),
        (false, 0..3600) => format!("{}:{:02}", whole / 60, whole % 60),
        (false, _) => format!(
            "{}:{:02}:{:02}",
            whole / 3600,
            whole % 3600 / 60,
            whole % 60
        ),
    }
}
