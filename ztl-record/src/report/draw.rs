//! The drawing: streams, and the tasks below them, on one axis.

use std::fmt::Write as _;
use std::time::Duration;

use ztl_script::drawing::{Axis, Drawing, Layout, escape};

use super::Drawn;
use super::series::Series;
use super::span::Span;
use super::streams::{IMAGES as MOST_IMAGES, Stream};
use super::tasks::Task;
use crate::form::to_base64;

/// Heights of rows, in units of the drawing.
const LINES: f64 = 56.0;
const SOUND: f64 = 44.0;
const MARKS: f64 = 22.0;
/// Size of an image in the wide layout.
const IMAGE: (f64, f64) = (84.0, 63.0);
/// The width of a letter of a remark, roughly.
const LETTER: f64 = 6.6;
/// Most tasks in the drawing; the table has more.
const TASKS: usize = 300;

/// All images, once, for both layouts.
pub(super) fn images(recorded: &Drawn, number: usize) -> String {
    let images = recorded
        .streams
        .shown
        .values()
        .flat_map(|stream| &stream.images);
    let images = images.enumerate().map(|(nth, (_, jpeg))| {
        format!(
            "<image id=\"image-{number}-{nth}\" width=\"{}\" height=\"{}\" preserveAspectRatio=\"xMinYMid\" href=\"data:image/jpeg;base64,{}\"/>\n",
            IMAGE.0,
            IMAGE.1,
            to_base64(jpeg)
        )
    });
    let images: String = images.collect();
    format!(
        "<svg class=\"defs\" width=\"0\" height=\"0\" aria-hidden=\"true\"><defs>\n{images}</defs></svg>\n"
    )
}

pub(super) fn timeline(recorded: &Drawn, layouts: [&'static Layout; 2], number: usize) -> String {
    layouts
        .map(|layout| timeline_in(recorded, layout, number))
        .concat()
}

/// Where rows are drawn.
struct Rows {
    drawing: Drawing,
    layout: &'static Layout,
    axis: Axis,
    span: Span,
    /// In the names of its images.
    number: usize,
    y: f64,
}

fn timeline_in(recorded: &Drawn, layout: &'static Layout, number: usize) -> String {
    let (left, right) = layout.bars();
    let length = Duration::from_nanos(recorded.span.length());
    let mut rows = Rows {
        drawing: Drawing::new(layout),
        layout,
        axis: Axis::new(Duration::ZERO, length, left, right),
        span: recorded.span,
        number,
        y: 20.0,
    };
    let mut nth_image = 0;
    for ((topic, publisher), stream) in &recorded.streams.shown {
        let name = format!("{topic} ({publisher})");
        rows.stream(&name, stream, &mut nth_image);
    }
    let tasks = &recorded.tasks.shown;
    for task in tasks.iter().take(TASKS) {
        rows.task(task);
    }
    if tasks.len() > TASKS {
        let more = tasks.len() - TASKS;
        rows.heading(&format!("and {more} more tasks, in the table"), "");
        rows.y += layout.row;
    }
    let Rows {
        mut drawing,
        axis,
        y,
        ..
    } = rows;
    drawing.height = y + 6.0;
    // Behind the rows.
    let rows = std::mem::take(&mut drawing.out);
    drawing.scale(&axis, 0.0, y);
    drawing.out += &rows;
    drawing.end(&format!("Timeline of {}", recorded.name))
}

impl Rows {
    /// The name of a row, and what is to say of it.
    fn heading(&mut self, name: &str, remark: &str) {
        let y = self.y + 14.0;
        let width = self.layout.name_width() - 6.0;
        self.drawing.cut("name task", 0.0, y, name, width);
        let (x, width) = self.layout.remark();
        self.drawing.cut("remark", x, y, remark, width);
    }

    /// Begins a row. Returns its top and bottom.
    fn row(&mut self, name: &str, remark: &str, height: f64) -> (f64, f64) {
        self.heading(name, remark);
        let top = self.y + self.layout.lift() + 2.0;
        self.y = top + height + 4.0;
        (top, top + height)
    }

    fn x(&self, part: f64) -> f64 {
        let (left, right) = self.layout.bars();
        left + part * (right - left)
    }

    fn stream(&mut self, name: &str, stream: &Stream, nth_image: &mut usize) {
        let messages = stream.messages;
        if !stream.lines.is_empty() {
            let ranges = stream.lines.values().filter_map(|series| series.range);
            let all = ranges.reduce(|(a, b), (c, d)| (a.min(c), b.max(d)));
            let (least, greatest) = all.unwrap_or_default();
            let remark = format!("{} to {}", short(least), short(greatest));
            self.line_names(stream.lines.keys(), &remark);
            let place = self.row(name, &remark, LINES);
            for (nth, (line, series)) in stream.lines.iter().enumerate() {
                self.line(nth, line, series, (least, greatest), place);
            }
        }
        if let Some((format, series)) = &stream.sound {
            let remark = format!("sound, {} Hz, {messages} blocks", format.rate);
            let place = self.row(name, &remark, SOUND);
            self.wave(series, place);
        }
        if !stream.images.is_empty() {
            let room = (self.x(1.0) - self.x(0.0)) / MOST_IMAGES as f64;
            let scale = (room / (IMAGE.0 + 4.0)).min(1.0);
            let height = IMAGE.1 * scale + 6.0;
            let place = self.row(name, &format!("{messages} images"), height);
            for (at, _) in &stream.images {
                let x = self.axis.x(self.span.at(*at));
                self.drawing.line("due", (x, place.0), (x, place.1));
                let _ = writeln!(
                    self.drawing.out,
                    "<use href=\"#image-{}-{nth_image}\" transform=\"translate({x:.1} {:.1}) scale({scale:.2})\"/>",
                    self.number,
                    place.0 + 3.0
                );
                *nth_image += 1;
            }
        }
        if !stream.marks.is_empty() {
            let remark = match stream.marks.len() as u64 {
                all if all == messages => format!("{messages} values"),
                marked => format!("{messages} values, {marked} marked"),
            };
            let place = self.row(name, &remark, MARKS);
            for (at, text) in &stream.marks {
                let x = self.axis.x(self.span.at(*at));
                let place = (place.0 + 4.0, place.1 - 4.0);
                self.drawing.bar("value", (x, x + 2.0), place, "", text);
            }
        }
    }

    /// The names of lines in their colours, behind the remark. Those without room are left out.
    fn line_names<'n>(&mut self, names: impl Iterator<Item = &'n String>, remark: &str) {
        let (x, width) = self.layout.remark();
        let mut at = x + (remark.chars().count() + 2) as f64 * LETTER;
        for (nth, name) in names.enumerate() {
            let length = name.chars().count() as f64 * LETTER;
            if at + length > x + width {
                return;
            }
            let class = format!("remark l{nth}");
            self.drawing.text(&class, at, self.y + 14.0, name);
            at += length + 2.0 * LETTER;
        }
    }

    fn line(
        &mut self,
        nth: usize,
        name: &str,
        series: &Series,
        (least, greatest): (f64, f64),
        (top, bottom): (f64, f64),
    ) {
        // Halves, since the difference of two finite numbers may be infinite.
        let room = (greatest / 2.0 - least / 2.0).max(f64::MIN_POSITIVE);
        let y = |value: f64| {
            let part = (value / 2.0 - least / 2.0) / room;
            bottom - part.clamp(0.0, 1.0) * (bottom - top)
        };
        let mut path = String::new();
        for (part, least, greatest) in series.steps() {
            let verb = if path.is_empty() { 'M' } else { 'L' };
            let x = self.x(part);
            let _ = write!(path, "{verb}{x:.1} {:.1}", y(least));
            if greatest > least {
                let _ = write!(path, "V{:.1}", y(greatest));
            }
        }
        let title = escape(if name.is_empty() { "value" } else { name });
        let _ = writeln!(
            self.drawing.out,
            "<path class=\"series s{nth}\" d=\"{path}\"><title>{title}</title></path>"
        );
    }

    fn wave(&mut self, series: &Series, (top, bottom): (f64, f64)) {
        let y = |value: f64| (top + bottom) / 2.0 - value / 32768.0 * (bottom - top) / 2.0;
        let mut path = String::new();
        for (part, least, greatest) in series.steps() {
            let x = self.x(part);
            // Silence is a line, too.
            let _ = write!(
                path,
                "M{x:.1} {:.1}V{:.1}",
                y(greatest) - 0.3,
                y(least) + 0.3
            );
        }
        let _ = writeln!(
            self.drawing.out,
            "<path class=\"wave\" d=\"{path}\"><title>sound</title></path>"
        );
    }

    fn task(&mut self, task: &Task) {
        let end = task.to.unwrap_or(self.span.to);
        let remark = format!(
            "{} {}{}",
            seconds(end.saturating_sub(task.from)),
            task.state,
            if task.to.is_none() {
                ", no end seen"
            } else {
                ""
            }
        );
        let name = task_name(task);
        self.heading(&name, &remark);
        let y = self.y + self.layout.lift();
        let x = |time| self.axis.x(self.span.at(time));
        let (from, to) = (x(task.from), x(end));
        let begun = task.accepted.map_or(from, x);
        let title = format!("{name}: {remark} {}", task.text);
        self.drawing
            .bar("asked", (from, begun), (y + 8.0, y + 12.0), "", &title);
        let class = format!("run {}", class(&task.state));
        let data = format!(" data-task=\"{}\"", escape(&task.id));
        self.drawing
            .bar(&class, (begun, to), (y + 5.0, y + 15.0), &data, &title);
        self.drawing
            .text("sign", to.max(begun) + 3.0, y + 15.0, sign(&task.state));
        self.y += self.layout.row;
    }
}

pub(super) fn task_name(task: &Task) -> String {
    let name = task.name.as_deref().unwrap_or("task");
    match task.id.as_str() {
        "" => format!("{name} ({})", task.scope),
        id => format!("{name} ({} {id})", task.scope),
    }
}

/// The class of a state in the style sheet.
pub(super) fn class(state: &str) -> &'static str {
    match state {
        "COMPLETED" => "completed",
        "ABORTED" => "aborted",
        "FAILED" | "REJECTED" | "NOT STARTED" => "failed",
        "UNKNOWN" => "unknown",
        _ => "open",
    }
}

fn sign(state: &str) -> &'static str {
    match state {
        "COMPLETED" => "✓",
        "ABORTED" => "■",
        "FAILED" | "REJECTED" | "NOT STARTED" => "✗",
        "UNKNOWN" => "?",
        _ => "›",
    }
}

pub(super) fn seconds(nanoseconds: u64) -> String {
    format!("{:.3} s", Duration::from_nanos(nanoseconds).as_secs_f64())
}

/// A number in a few digits.
fn short(number: f64) -> String {
    match number.abs() {
        size if size != 0.0 && !(1e-3..1e6).contains(&size) => format!("{number:.2e}"),
        _ => format!("{}", (number * 1000.0).round() / 1000.0),
    }
}
