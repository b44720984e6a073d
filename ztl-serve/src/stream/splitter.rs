//! Splits the output of a program into frames, without I/O. Takes time in proportion to the output, and memory for at
//! most one frame.

/// How the frames of a stream are told apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Framing {
    /// Each line, without its line break.
    Line,
    /// The same, and each that is not blank is a value in JSON.
    Json,
    /// JPEG images one after the other.
    Jpeg,
    /// A length of 32 bits, the highest byte first, before each frame.
    Length,
    /// So many bytes, at least one.
    Fixed(usize),
}

/// What the splitter has found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Piece<'a> {
    Frame(&'a [u8]),
    /// A frame that is longer than the limit was dropped.
    TooLong,
    /// Bytes that are not part of an image were dropped.
    NotJpeg,
}

/// Bytes between two images that may be there, such as the headers of a multipart stream.
const GAP: usize = 4096;

const SOI: u8 = 0xd8;
const EOI: u8 = 0xd9;
/// Start of scan: compressed data follows its segment.
const SOS: u8 = 0xda;

/// Where in an image the splitter is, or between two.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Jpeg {
    /// Before an image, after so many bytes; whether the last byte was 0xff.
    Before(usize, bool),
    /// A marker must begin.
    Marker,
    /// In compressed data.
    Data,
    /// After 0xff: the code of a marker; whether this is in compressed data.
    Code(bool),
    /// In the length of a segment: the marker's code, and the first byte if there was one.
    Length(u8, Option<u8>),
    /// So many bytes of a segment follow, and then compressed data or a marker.
    Segment(usize, bool),
}

/// The state of a program's output.
#[derive(Debug)]
pub(crate) struct Splitter {
    framing: Framing,
    /// Most bytes of a frame.
    longest: usize,
    /// The beginning of a frame.
    frame: Vec<u8>,
    /// Whether the frame is too long, so that it is dropped.
    is_dropped: bool,
    /// Bytes to drop, of a frame whose length is known.
    skip: usize,
    jpeg: Jpeg,
}

impl Splitter {
    pub(crate) const fn new(framing: Framing, longest: usize) -> Self {
        Self {
            framing,
            longest,
            frame: Vec::new(),
            is_dropped: false,
            skip: 0,
            jpeg: Jpeg::Before(0, false),
        }
    }

    /// Takes output; passes on what it completes. A frame without its end is never passed on.
    pub(crate) fn push(&mut self, bytes: &[u8], mut found: impl FnMut(Piece<'_>)) {
        match self.framing {
            Framing::Line | Framing::Json => self.lines(bytes, &mut found),
            Framing::Jpeg => self.images(bytes, &mut found),
            Framing::Length => self.lengths(bytes, &mut found),
            Framing::Fixed(size) => self.blocks(bytes, size, &mut found),
        }
    }

    fn lines(&mut self, bytes: &[u8], found: &mut impl FnMut(Piece<'_>)) {
        for piece in bytes.split_inclusive(|byte| *byte == b'\n') {
            let line = piece.strip_suffix(b"\n");
            self.keep(line.unwrap_or(piece), found);
            if line.is_some() {
                if self.frame.ends_with(b"\r") {
                    self.frame.pop();
                }
                self.end(found);
            }
        }
    }

    fn blocks(&mut self, mut bytes: &[u8], size: usize, found: &mut impl FnMut(Piece<'_>)) {
        while !bytes.is_empty() {
            bytes = self.fill(bytes, size);
            if self.frame.len() >= size {
                self.end(found);
            }
        }
    }

    fn lengths(&mut self, mut bytes: &[u8], found: &mut impl FnMut(Piece<'_>)) {
        loop {
            let skipped = self.skip.min(bytes.len());
            self.skip -= skipped;
            bytes = bytes.get(skipped..).unwrap_or_default();
            bytes = self.fill(bytes, 4);
            let Some(length) = self.frame.first_chunk() else {
                return;
            };
            let length = u32::from_be_bytes(*length) as usize;
            if length > self.longest {
                found(Piece::TooLong);
                self.frame.clear();
                self.skip = length;
                continue;
            }
            bytes = self.fill(bytes, 4 + length);
            if self.frame.len() < 4 + length {
                return;
            }
            found(Piece::Frame(self.frame.get(4..).unwrap_or_default()));
            self.frame.clear();
        }
    }

    fn images(&mut self, bytes: &[u8], found: &mut impl FnMut(Piece<'_>)) {
        // Where the part of the image begins that is not kept yet, and how far it was looked at.
        let (mut begin, mut at) = (0, 0);
        while let Some(byte) = bytes.get(at).copied() {
            at += 1;
            let next = match (self.jpeg, byte) {
                (Jpeg::Before(_, true), SOI) => {
                    self.frame.push(0xff);
                    begin = at - 1;
                    Some(Jpeg::Marker)
                }
                (Jpeg::Before(count, _), _) => {
                    if count == GAP {
                        found(Piece::NotJpeg);
                    }
                    Some(Jpeg::Before(count.saturating_add(1), byte == 0xff))
                }
                (Jpeg::Marker, 0xff) => Some(Jpeg::Code(false)),
                (Jpeg::Data, 0xff) => Some(Jpeg::Code(true)),
                (Jpeg::Data, _) => {
                    let rest = bytes.get(at..).unwrap_or_default();
                    let end = rest.iter().position(|byte| *byte == 0xff);
                    at += end.unwrap_or(rest.len());
                    Some(Jpeg::Data)
                }
                // Bytes 0xff may fill the space before a code.
                (Jpeg::Code(_), 0xff) => Some(self.jpeg),
                // Data that looks like a marker, and markers without a segment.
                (Jpeg::Code(true), 0 | 0xd0..=0xd7) => Some(Jpeg::Data),
                (Jpeg::Code(false), 1 | 0xd0..=0xd7) => Some(Jpeg::Marker),
                (Jpeg::Code(_), EOI) => {
                    self.keep(bytes.get(begin..at).unwrap_or_default(), found);
                    self.end(found);
                    Some(Jpeg::Before(0, false))
                }
                (Jpeg::Code(_), 0xc0..=0xcf | SOS..=0xfe) => Some(Jpeg::Length(byte, None)),
                (Jpeg::Length(code, None), _) => Some(Jpeg::Length(code, Some(byte))),
                (Jpeg::Length(code, Some(high)), _) => {
                    // The length counts its own two bytes.
                    let rest = usize::from(u16::from_be_bytes([high, byte])).checked_sub(2);
                    rest.map(|rest| segment(rest, code == SOS))
                }
                (Jpeg::Segment(rest, is_scan), _) => {
                    let more = (rest - 1).min(bytes.len() - at);
                    at += more;
                    Some(segment(rest - 1 - more, is_scan))
                }
                (Jpeg::Marker | Jpeg::Code(_), _) => None,
            };
            self.jpeg = next.unwrap_or_else(|| {
                found(Piece::NotJpeg);
                self.reset();
                // A new image begins in the middle of this one.
                if matches!(self.jpeg, Jpeg::Code(_)) && byte == SOI {
                    self.frame.push(0xff);
                    begin = at - 1;
                    return Jpeg::Marker;
                }
                Jpeg::Before(0, false)
            });
        }
        if !matches!(self.jpeg, Jpeg::Before(..)) {
            self.keep(bytes.get(begin..).unwrap_or_default(), found);
        }
    }

    /// Adds bytes until the frame has this size; returns the others.
    fn fill<'b>(&mut self, bytes: &'b [u8], size: usize) -> &'b [u8] {
        let lacking = size.saturating_sub(self.frame.len()).min(bytes.len());
        let (part, rest) = bytes.split_at(lacking);
        self.frame.extend_from_slice(part);
        rest
    }

    /// Adds bytes to the frame, unless it becomes too long.
    fn keep(&mut self, bytes: &[u8], found: &mut impl FnMut(Piece<'_>)) {
        if self.is_dropped {
            return;
        }
        if self.frame.len() + bytes.len() > self.longest {
            found(Piece::TooLong);
            self.reset();
            self.is_dropped = true;
            return;
        }
        self.frame.extend_from_slice(bytes);
    }

    /// The frame is complete.
    fn end(&mut self, found: &mut impl FnMut(Piece<'_>)) {
        if !self.is_dropped {
            found(Piece::Frame(&self.frame));
        }
        self.is_dropped = false;
        self.frame.clear();
    }

    fn reset(&mut self) {
        self.frame = Vec::new();
        self.is_dropped = false;
    }
}

/// After the length of a segment: so many bytes are left.
const fn segment(rest: usize, is_scan: bool) -> Jpeg {
    match (rest, is_scan) {
        (0, true) => Jpeg::Data,
        (0, false) => Jpeg::Marker,
        _ => Jpeg::Segment(rest, is_scan),
    }
}
