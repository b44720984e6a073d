//! The layouts of a timeline: for wide and for narrow windows.

/// Widths of names, bars and remarks, in units of the drawing.
#[derive(Debug)]
pub struct Layout {
    pub(crate) class: &'static str,
    /// Width of the whole drawing.
    pub width: f64,
    /// Width of the names left of the bars; `None`: names and remarks are above their bars.
    pub(crate) names: Option<f64>,
    /// The left end of bars below their names.
    pub(crate) left: f64,
    /// Width of the names in the overview.
    pub overview: f64,
    /// Width of the remarks beside the bars.
    pub(crate) remarks: f64,
    /// Height of a row.
    pub row: f64,
    /// Most labels on the scale.
    pub(crate) ticks: f64,
}

/// For wide windows.
pub const WIDE: Layout = Layout {
    class: "wide",
    width: 1180.0,
    names: Some(300.0),
    left: 0.0,
    overview: 110.0,
    remarks: 256.0,
    row: 21.0,
    ticks: 9.0,
};

/// For phones, unscaled.
pub const NARROW: Layout = Layout {
    class: "narrow",
    width: 366.0,
    names: None,
    left: 2.0,
    overview: 58.0,
    remarks: 176.0,
    row: 38.0,
    ticks: 4.0,
};

/// As [`WIDE`] and [`NARROW`], for a drawing below an overview: on the overview's axis, with names above the bars.
pub const BELOW_OVERVIEW: [Layout; 2] = [below_overview(WIDE), below_overview(NARROW)];

const fn below_overview(layout: Layout) -> Layout {
    Layout {
        names: None,
        left: layout.overview,
        row: NARROW.row,
        ..layout
    }
}

impl Layout {
    /// The left and right ends of the bars.
    #[must_use]
    pub const fn bars(&self) -> (f64, f64) {
        match self.names {
            Some(names) => (names, self.width - self.remarks),
            None => (self.left, self.width - 14.0),
        }
    }

    /// Distance of the bars of a row below its names.
    #[must_use]
    pub const fn lift(&self) -> f64 {
        match self.names {
            Some(_) => 0.0,
            None => 15.0,
        }
    }

    /// Width of the name of a row.
    #[must_use]
    pub fn name_width(&self) -> f64 {
        self.names.unwrap_or(self.width - self.remarks)
    }

    /// Place and width of the remark of a row.
    #[must_use]
    pub fn remark(&self) -> (f64, f64) {
        let gap = if self.names.is_some() { 20.0 } else { 6.0 };
        (self.width - self.remarks + gap, self.remarks - gap)
    }
}
