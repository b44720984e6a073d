//! What moves: the part of a node that its firmware provides.

use core::time::Duration;

use heapless::string::StringView;
use ztl_core::Instant;
use ztl_core::link::Offer;
use ztl_core::sink::{SliceSink, put_fixed};

/// How a component's task goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum Run {
    /// Under way; the report is where it is now.
    Running,
    /// The goal is reached; the report is the result.
    Completed,
    /// The goal will not be reached; the report says why.
    Failed,
    /// Stopped after [`Component::abort`]; the report is where.
    Aborted,
}

/// Something that carries out one task at a time.
///
/// The node calls, in this order: `start`; then `poll` again and again until it says other than
/// [`Run::Running`]; `abort` and `make_safe` at any time. No call may block: each is made from the
/// main loop, between two bytes of the link.
pub trait Component {
    /// What it is and which goals it takes; told to the gateway once a session. Must not change.
    fn offer(&self) -> Offer<'_>;

    /// Begins a task. Called only while none runs.
    ///
    /// # Errors
    /// What is wrong with the goal and what would be right, for the person who wrote it; nothing
    /// has moved then. The gateway adds the goal itself.
    fn start(&mut self, now: Instant, goal: &str) -> Result<(), &'static str>;

    /// Moves the task on and reports. After anything but [`Run::Running`] the task is over.
    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run;

    /// Stops the task as soon as it is safe; a later `poll` says [`Run::Aborted`] (or how else it
    /// ended).
    fn abort(&mut self, now: Instant);

    /// Goes to the safe state at once, whatever runs: the link was lost, or an emergency stop. For
    /// [`Loss::Hold`](ztl_core::link::Loss::Hold) that is to keep the position under power. A task that ran is over, without
    /// another `poll`.
    fn make_safe(&mut self, now: Instant);

    /// When `poll` is to be called next while a task runs. Default: after 10 ms.
    fn poll_timeout(&self, now: Instant) -> Instant {
        now + Duration::from_millis(10)
    }
}

/// Where a component writes its progress or result; of fixed length.
///
/// What does not fit is cut, and `…` marks the cut. It starts empty at each `poll`.
#[derive(Debug)]
pub struct Report<'a> {
    text: &'a mut StringView,
    cut: bool,
}

const MARK: &str = "…";

impl<'a> Report<'a> {
    pub(crate) fn new(text: &'a mut StringView) -> Self {
        text.clear();
        Self { text, cut: false }
    }

    /// Adds text.
    pub fn text(&mut self, text: &str) {
        if self.cut || self.text.push_str(text).is_ok() {
            return;
        }
        self.cut = true;
        let room = self.text.capacity().saturating_sub(MARK.len());
        let fitting = text.floor_char_boundary(room.saturating_sub(self.text.len()));
        let _ = self.text.push_str(text.get(..fitting).unwrap_or_default());
        while self.text.len() > room && self.text.pop().is_some() {}
        let _ = self.text.push_str(MARK);
    }

    /// Adds a number with this many decimals (at most 6).
    pub fn number(&mut self, value: f32, decimals: u8) {
        let mut buffer = [0; 32];
        let mut sink = SliceSink::new(&mut buffer);
        put_fixed(&mut sink, value, decimals);
        let digits = sink.finish().unwrap_or_default();
        self.text(core::str::from_utf8(digits).unwrap_or_default());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_that_does_not_fit_is_cut_and_marked() {
        for (parts, expected) in [
            (&["12345678"][..], "12345678"),
            (&["123456789"], "12345…"),
            (&["1234567", "89"], "12345…"),
            (&["1234", "ä", "ä", "ä"], "1234…"),
            (&["ääää", "x", "y"], "ää…"),
        ] {
            let mut text = heapless::String::<8>::new();
            let mut report = Report::new(&mut text);
            for part in parts {
                report.text(part);
            }
            assert_eq!(text.as_str(), expected);
        }
    }
}
