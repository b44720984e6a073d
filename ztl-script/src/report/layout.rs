//! The layouts of a timeline: for wide and for narrow windows.

/// Widths of names, bars and remarks, in units of the drawing.
pub(super) struct Layout {
    pub(super) class: &'static str,
    pub(super) width: f64,
    /// Width of the names left of the bars; `None`: names and remarks are above their bars.
    pub(super) names: Option<f64>,
    /// Width of the names in the overview.
    pub(super) overview: f64,
    /// Width of the remarks beside the bars.
    pub(super) remarks: f64,
    pub(super) row: f64,
    /// Most labels on the scale.
    pub(super) ticks: f64,
}

pub(super) const WIDE: Layout = Layout {
    class: "wide",
    width: 1180.0,
    names: Some(300.0),
    overview: 110.0,
    remarks: 256.0,
    row: 21.0,
    ticks: 9.0,
};

/// For phones, unscaled.
pub(super) const NARROW: Layout = Layout {
    class: "narrow",
    width: 366.0,
    names: None,
    overview: 58.0,
    remarks: 176.0,
    row: 38.0,
    ticks: 4.0,
};

impl Layout {
    /// The left and right ends of the bars.
    pub(super) const fn bars(&self) -> (f64, f64) {
        match self.names {
            Some(names) => (names, self.width - self.remarks),
            None => (2.0, self.width - 14.0),
        }
    }

    /// Distance of the bars of a row below its names.
    pub(super) const fn lift(&self) -> f64 {
        match self.names {
            Some(_) => 0.0,
            None => 15.0,
        }
    }

    /// Width of the name of a row.
    pub(super) fn name_width(&self) -> f64 {
        self.names.unwrap_or(self.width - self.remarks)
    }

    /// Place and width of the remark of a row.
    pub(super) fn remark(&self) -> (f64, f64) {
        let gap = if self.names.is_some() { 20.0 } else { 6.0 };
        (self.width - self.remarks + gap, self.remarks - gap)
    }
}
