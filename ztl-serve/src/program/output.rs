//! A program's output, split into lines; only a bounded part is kept.

/// Which lines are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Keep {
    /// The last one that is not blank.
    Last,
    All,
    None,
}

/// The output of a program.
#[derive(Debug)]
pub(crate) struct Output {
    keep: Keep,
    /// Most bytes that are kept, in all and of each line.
    most: usize,
    /// The unfinished line.
    line: Vec<u8>,
    line_cut: bool,
    kept: Vec<u8>,
    kept_cut: bool,
}

/// What was kept of a program's output.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Kept {
    /// Without the last line break. Bytes that are not UTF-8 are U+FFFD.
    pub(crate) text: String,
    /// Whether there was more.
    pub(crate) cut: bool,
}

impl Output {
    pub(crate) const fn new(keep: Keep, most: usize) -> Self {
        Self {
            keep,
            most,
            line: Vec::new(),
            line_cut: false,
            kept: Vec::new(),
            kept_cut: false,
        }
    }

    /// Adds output. Keeps the complete lines for which `is_progress` is false.
    pub(crate) fn push(&mut self, bytes: &[u8], mut is_progress: impl FnMut(&[u8]) -> bool) {
        for piece in bytes.split_inclusive(|byte| *byte == b'\n') {
            let (piece, ends) = match piece.split_last() {
                Some((b'\n', line)) => (line, true),
                _ => (piece, false),
            };
            let room = self.most.saturating_sub(self.line.len());
            let fitting = piece.get(..room).unwrap_or(piece);
            self.line_cut |= fitting.len() < piece.len();
            self.line.extend_from_slice(fitting);
            if ends {
                self.end_line(&mut is_progress);
            }
        }
    }

    /// The output has ended: its last line is complete.
    pub(crate) fn end(&mut self, mut is_progress: impl FnMut(&[u8]) -> bool) {
        if !self.line.is_empty() {
            self.end_line(&mut is_progress);
        }
    }

    /// What was kept of the complete lines.
    pub(crate) fn kept(&self) -> Kept {
        let text = String::from_utf8_lossy(&self.kept);
        Kept {
            text: text.trim_end_matches(['\n', '\r']).to_owned(),
            cut: self.kept_cut,
        }
    }

    fn end_line(&mut self, is_progress: &mut impl FnMut(&[u8]) -> bool) {
        let line = self.line.strip_suffix(b"\r").unwrap_or(&self.line);
        let is_progress = is_progress(line);
        match self.keep {
            _ if is_progress => {}
            Keep::Last if line.trim_ascii().is_empty() => {}
            Keep::Last => {
                self.kept.clear();
                self.kept.extend_from_slice(line);
                self.kept_cut = self.line_cut;
            }
            Keep::All => {
                let room = self.most.saturating_sub(self.kept.len());
                let fitting = self.line.get(..room).unwrap_or(&self.line);
                self.kept_cut |= self.line_cut || fitting.len() < self.line.len();
                self.kept.extend_from_slice(fitting);
                if !self.kept_cut {
                    self.kept.push(b'\n');
                }
            }
            Keep::None => {}
        }
        self.line.clear();
        self.line_cut = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is kept of output in pieces of every length. Lines with `@` are progress.
    #[track_caller]
    fn kept(keep: Keep, most: usize, bytes: &[u8]) -> (String, bool) {
        let mut first = None;
        for size in 1..=bytes.len().max(1) {
            let mut output = Output::new(keep, most);
            let mut progress = Vec::new();
            let mut is_progress = |line: &[u8]| {
                let is = line.starts_with(b"@");
                progress.extend(is.then(|| line.to_vec()));
                is
            };
            for piece in bytes.chunks(size) {
                output.push(piece, &mut is_progress);
            }
            output.end(&mut is_progress);
            let kept = output.kept();
            let this = ((kept.text, kept.cut), progress);
            assert_eq!(first.get_or_insert_with(|| this.clone()), &this, "{size}");
        }
        first.expect("at least once").0
    }

    #[test]
    fn the_last_line_that_is_not_blank_is_kept() {
        let of = |bytes: &[u8]| kept(Keep::Last, 10, bytes);
        assert_eq!(of(b"one\ntwo\r\n\n  \n@ 3\n"), ("two".to_owned(), false));
        assert_eq!(of(b"one\nend"), ("end".to_owned(), false));
        assert_eq!(of(b""), (String::new(), false));
        assert_eq!(of(b"0123456789abc\n"), ("0123456789".to_owned(), true));
        assert_eq!(of(b"0123456789abc\nshort"), ("short".to_owned(), false));
        assert_eq!(of(b"\xff\0\n"), ("\u{fffd}\0".to_owned(), false));
    }

    #[test]
    fn all_lines_are_kept_up_to_the_limit() {
        let of = |bytes: &[u8]| kept(Keep::All, 10, bytes);
        assert_eq!(of(b"one\n@ 1\n\ntwo\n"), ("one\n\ntwo".to_owned(), false));
        assert_eq!(of(b"one\ntwo\nthree\n"), ("one\ntwo\nth".to_owned(), true));
        assert_eq!(of(&[b'x'; 1000]), ("x".repeat(10), true));
        assert_eq!(kept(Keep::None, 10, b"one\n"), (String::new(), false));
    }
}
