//! HTML. Every text of a record goes through [`escape`].

use std::fmt::Write;

/// Escapes a text for elements, quoted attributes and SVG. Control characters and those that change the
/// direction of text become U+FFFD.
pub(super) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for char in text.chars() {
        match char {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            '\n' | '\t' => out.push(' '),
            '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => out.push('\u{fffd}'),
            control if control.is_control() => out.push('\u{fffd}'),
            other => out.push(other),
        }
    }
    out
}

/// A text of at most so many characters: the beginning and the end of a longer one.
pub(super) fn shorten(text: &str, most: usize) -> String {
    let count = text.chars().count();
    if count <= most {
        return text.to_owned();
    }
    let tail = most / 3;
    let head: String = text.chars().take(most.saturating_sub(tail + 1)).collect();
    let tail: String = text.chars().skip(count - tail).collect();
    format!("{head}…{tail}")
}

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
            let _ = write!(out, "<th{class}>{}</th>", escape(name));
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn markup_in_text_is_escaped() {
        assert_eq!(
            escape("<b onclick=\"x('&')\">\u{202e}\u{7}\n"),
            "&lt;b onclick=&quot;x(&#39;&amp;&#39;)&quot;&gt;\u{fffd}\u{fffd} "
        );
    }

    #[test]
    fn a_long_name_keeps_its_beginning_and_end() {
        assert_eq!(shorten("short", 9), "short");
        let short = shorten("a very long name of a scene, take 2", 15);
        assert_eq!(short, "a very lo…ake 2");
        assert_eq!(short.chars().count(), 15);
    }
}
