//! Splits Server-Sent Events, without I/O.

use std::mem;

/// An event: its name, if it has one, and its data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct SseEvent {
    pub(super) name: Option<String>,
    pub(super) data: Vec<u8>,
}

/// Finds events in bytes. It keeps a line, a name and data, of at most `longest` bytes each.
#[derive(Debug)]
pub(super) struct SseReader {
    longest: usize,
    line: Vec<u8>,
    /// The last line has ended with a carriage return, so that a line feed belongs to it.
    after_return: bool,
    is_first_line: bool,
    name: Option<String>,
    data: Option<Vec<u8>>,
}

/// A line, or the name or the data of an event is too long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct TooLong;

impl SseReader {
    /// At the beginning of an answer. `longest`: most bytes of a line, and of the name and the data of an event.
    pub(super) const fn new(longest: usize) -> Self {
        Self {
            longest,
            line: Vec::new(),
            after_return: false,
            is_first_line: true,
            name: None,
            data: None,
        }
    }

    /// Takes more bytes, and passes on the events that they end.
    ///
    /// # Errors
    /// Something is too long. The reader is of no use then.
    pub(super) fn push(
        &mut self,
        bytes: &[u8],
        mut on_event: impl FnMut(SseEvent),
    ) -> Result<(), TooLong> {
        for byte in bytes {
            let after_return = mem::replace(&mut self.after_return, *byte == b'\r');
            match byte {
                b'\n' if after_return => {}
                b'\n' | b'\r' => {
                    if let Some(event) = self.end_line()? {
                        on_event(event);
                    }
                }
                byte if self.line.len() < self.longest => self.line.push(*byte),
                _ => return Err(TooLong),
            }
        }
        Ok(())
    }

    fn end_line(&mut self) -> Result<Option<SseEvent>, TooLong> {
        let line = mem::take(&mut self.line);
        let mut line = line.as_slice();
        if mem::take(&mut self.is_first_line) {
            // A byte order mark.
            line = line.strip_prefix(b"\xef\xbb\xbf").unwrap_or(line);
        }
        if line.is_empty() {
            let name = self.name.take();
            return Ok(self.data.take().map(|data| SseEvent { name, data }));
        }
        let colon = line.iter().position(|byte| *byte == b':');
        let (field, value) = match colon.and_then(|at| line.split_at_checked(at)) {
            Some((field, value)) => (field, value.get(1..).unwrap_or_default()),
            None => (line, &[][..]),
        };
        let value = value.strip_prefix(b" ").unwrap_or(value);
        match field {
            b"event" => {
                let name = String::from_utf8_lossy(value);
                // A byte that is not UTF-8 becomes three.
                if name.len() > self.longest {
                    return Err(TooLong);
                }
                self.name = Some(name.into_owned()).filter(|name| !name.is_empty());
            }
            b"data" => {
                let data = match &mut self.data {
                    Some(data) => {
                        data.push(b'\n');
                        data
                    }
                    none => none.insert(Vec::new()),
                };
                if data.len() + value.len() > self.longest {
                    return Err(TooLong);
                }
                data.extend_from_slice(value);
            }
            // Comments, which begin with a colon, and what only matters to a browser.
            _ => {}
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn events(bytes: &[u8], step: usize) -> Result<Vec<(String, String)>, TooLong> {
        let mut reader = SseReader::new(20);
        let mut events = Vec::new();
        for part in bytes.chunks(step) {
            reader.push(part, |event| {
                let data = String::from_utf8(event.data).expect("UTF-8");
                events.push((event.name.unwrap_or_default(), data));
            })?;
        }
        Ok(events)
    }

    #[test]
    fn events_are_found_however_lines_end_and_wherever_they_are_cut() {
        let text = "\u{feff}data: one\n\n: silence\r\n\r\nevent:touch\rdata:{\rdata: }\r\rid: 7\nretry\n\
                    event: only a name\n\ndata\ndata\n\ndata: never ended";
        let found = [("", "one"), ("touch", "{\n}"), ("", "\n")];
        let found = found.map(|(name, data)| (name.to_owned(), data.to_owned()));
        for step in 1..=text.len() {
            let events = events(text.as_bytes(), step);
            assert_eq!(events.as_deref(), Ok(found.as_slice()), "{step}");
        }
    }

    #[test]
    fn what_is_too_long_ends_the_reader() {
        assert_eq!(events(&[b'x'; 21], 1), Err(TooLong));
        assert_eq!(
            events(b"event: \xff\xff\xff\xff\xff\xff\xff\n", 1),
            Err(TooLong)
        );
        assert_eq!(
            events(b"data: 12345678901\ndata: 12345678901\n\n", 9),
            Err(TooLong)
        );
    }
}
