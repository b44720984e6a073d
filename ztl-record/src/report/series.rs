//! Numbers over time, in so many steps as can be drawn.

use super::span::Span;

/// Steps of a series: as many as there is room for in the widest drawing.
const STEPS: usize = 640;

/// The least and the greatest number in each step of time.
#[derive(Debug, Clone)]
pub(super) struct Series {
    steps: Vec<Option<(f64, f64)>>,
    /// Least and greatest of all.
    pub(super) range: Option<(f64, f64)>,
}

impl Series {
    pub(super) fn new() -> Self {
        Self {
            steps: vec![None; STEPS],
            range: None,
        }
    }

    /// Adds a number, unless it is infinite or NaN.
    pub(super) fn add(&mut self, span: Span, time: u64, number: f64) {
        if !number.is_finite() {
            return;
        }
        let passed = time.saturating_sub(span.from).min(span.length());
        let part = passed as f64 / span.length().max(1) as f64;
        let step = (part * (STEPS - 1) as f64) as usize;
        let widen = |range: &mut Option<(f64, f64)>| {
            let (least, greatest) = range.unwrap_or((number, number));
            *range = Some((least.min(number), greatest.max(number)));
        };
        if let Some(step) = self.steps.get_mut(step) {
            widen(step);
        }
        widen(&mut self.range);
    }

    /// The steps with numbers: the part of the time that has passed, least and greatest.
    pub(super) fn steps(&self) -> impl Iterator<Item = (f64, f64, f64)> {
        let steps = self.steps.iter().enumerate();
        steps.filter_map(|(nth, step)| {
            let (least, greatest) = (*step)?;
            Some((nth as f64 / (STEPS - 1) as f64, least, greatest))
        })
    }
}
