//! Tables in HTML.

use std::fmt::Write as _;

use crate::drawing::escape;

/// A table; its cells are HTML.
pub(super) struct Table {
    out: String,
    /// The attributes of each column's cells. Narrow pages show the column's name in each cell.
    attributes: Vec<String>,
}

impl Table {
    /// `columns`: their names; `#` in front marks numbers, `~` long text.
    pub(super) fn new(class: &str, columns: &[&str]) -> Self {
        let mut out = format!("<div class=\"scroll\"><table class=\"{class}\"><thead><tr>");
        for column in columns {
            let (class, name) = column_class(column);
            // A column without a name has no heading.
            let cell = if name.is_empty() { "td" } else { "th" };
            let _ = write!(out, "<{cell}{class}>{}</{cell}>", escape(name));
        }
        out.push_str("</tr></thead><tbody>\n");
        Self {
            out,
            attributes: columns
                .iter()
                .map(|column| {
                    let (class, name) = column_class(column);
                    format!("{class} data-name=\"{}\"", escape(name))
                })
                .collect(),
        }
    }

    pub(super) fn row(&mut self, class: &str, cells: &[String]) {
        match class {
            "" => self.out.push_str("<tr>"),
            class => {
                let _ = write!(self.out, "<tr class=\"{class}\">");
            }
        }
        for (cell, attributes) in cells.iter().zip(&self.attributes) {
            let _ = write!(self.out, "<td{attributes}>{cell}</td>");
        }
        self.out.push_str("</tr>\n");
    }

    pub(super) fn end(mut self) -> String {
        self.out.push_str("</tbody></table></div>\n");
        self.out
    }
}

fn column_class(column: &str) -> (&'static str, &str) {
    if let Some(name) = column.strip_prefix('#') {
        (" class=\"n\"", name)
    } else if let Some(name) = column.strip_prefix('~') {
        (" class=\"long\"", name)
    } else {
        ("", column)
    }
}
