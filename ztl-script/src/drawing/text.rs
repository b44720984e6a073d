//! Text in HTML and SVG. Every text of a record goes through [`escape`].

/// Escapes a text for elements, quoted attributes and SVG. Control characters and those that change the
/// direction of text become U+FFFD.
#[must_use]
pub fn escape(text: &str) -> String {
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
#[must_use]
pub fn shorten(text: &str, most: usize) -> String {
    let count = text.chars().count();
    if count <= most {
        return text.to_owned();
    }
    let tail = most / 3;
    let head: String = text.chars().take(most.saturating_sub(tail + 1)).collect();
    let tail: String = text.chars().skip(count - tail).collect();
    format!("{head}…{tail}")
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
