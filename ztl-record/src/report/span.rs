//! The time of a recording.

/// First and last time of a recording, in nanoseconds since 1970.
#[derive(Debug, Clone, Copy)]
pub(super) struct Span {
    pub(super) from: u64,
    pub(super) to: u64,
}

impl Span {
    pub(super) fn widen(span: &mut Option<Self>, at: u64) {
        let span = span.get_or_insert(Self { from: at, to: at });
        *span = Self {
            from: span.from.min(at),
            to: span.to.max(at),
        };
    }

    pub(super) const fn length(self) -> u64 {
        self.to.saturating_sub(self.from)
    }

    /// From its start to a time.
    pub(super) const fn at(self, time: u64) -> std::time::Duration {
        std::time::Duration::from_nanos(time.saturating_sub(self.from))
    }
}
