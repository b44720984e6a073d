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
                    // The first byte of an image may follow the gap.
                    if count == GAP + 1 {
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
            self.jpeg = match next {
                Some(next) => next,
                None => {
                    self.keep(bytes.get(begin..at).unwrap_or_default(), found);
                    found(Piece::NotJpeg);
                    self.reset();
                    match (self.jpeg, byte) {
                        // A new image begins in the middle of this one.
                        (Jpeg::Code(_), SOI) => {
                            self.frame.push(0xff);
                            begin = at - 1;
                            Jpeg::Marker
                        }
                        _ => Jpeg::Before(0, false),
                    }
                }
            };
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

#[cfg(test)]
mod tests {
    use ztl_tests::garbage::Garbage;

    use super::*;

    const THUMBNAIL: &[u8] = include_bytes!("../../../tests/serve/images/thumbnail.jpg");
    const PROGRESSIVE: &[u8] = include_bytes!("../../../tests/serve/images/progressive.jpg");
    /// With a filled marker, one without a segment, and data that looks like one.
    const SMALL: &[u8] =
        b"\xff\xd8\xff\x01\xff\xff\xe0\0\x04\xff\xd9\xff\xda\0\x02d\xff\0\xff\xd7\xff\xff\xd9";
    const LONGEST: usize = 8192;

    #[derive(Debug, Clone, PartialEq, Eq)]
    enum Found {
        Frame(Vec<u8>),
        TooLong,
        NotJpeg,
    }

    use Found::{Frame, NotJpeg, TooLong};

    fn push(splitter: &mut Splitter, bytes: &[u8], found: &mut Vec<Found>) {
        splitter.push(bytes, |piece| {
            found.push(match piece {
                Piece::Frame(frame) => Frame(frame.to_vec()),
                Piece::TooLong => TooLong,
                Piece::NotJpeg => NotJpeg,
            });
        });
        let held = splitter.frame.capacity();
        assert!(held <= 2 * (splitter.longest + 4), "{held}");
    }

    /// What output has in it. The same, wherever it is cut into two, and in pieces of each length up to 100.
    #[track_caller]
    fn of(framing: Framing, longest: usize, bytes: &[u8]) -> Vec<Found> {
        let split = |pieces: &mut dyn Iterator<Item = &[u8]>| {
            let mut splitter = Splitter::new(framing, longest);
            let mut found = Vec::new();
            for piece in pieces {
                push(&mut splitter, piece, &mut found);
            }
            found
        };
        let whole = split(&mut std::iter::once(bytes));
        for cut in 0..=bytes.len() {
            let (left, right) = bytes.split_at(cut);
            assert_eq!(split(&mut [left, right].into_iter()), whole, "cut at {cut}");
        }
        for length in 1..100 {
            assert_eq!(split(&mut bytes.chunks(length)), whole, "by {length}");
        }
        whole
    }

    fn frames(frames: &[&[u8]]) -> Vec<Found> {
        frames.iter().map(|frame| Frame(frame.to_vec())).collect()
    }

    #[test]
    fn lines_end_with_their_line_breaks() {
        let lines = |bytes| of(Framing::Line, 8, bytes);
        assert_eq!(
            lines(b"1\n\n\xff2\r\n3\r4\nrest"),
            frames(&[b"1", b"", b"\xff2", b"3\r4"])
        );
        assert_eq!(
            lines(b"12345678\n123456789\n1234567\r\n1234567890123456789\n1\n"),
            [
                Frame(b"12345678".to_vec()),
                TooLong,
                Frame(b"1234567".to_vec()),
                TooLong,
                Frame(b"1".to_vec())
            ]
        );
        assert_eq!(lines(&[b'x'; 1000]), [TooLong]);
    }

    #[test]
    fn blocks_have_their_length() {
        let blocks = of(Framing::Fixed(3), 1, b"123456789a");
        assert_eq!(blocks, frames(&[b"123", b"456", b"789"]));
        assert_eq!(of(Framing::Fixed(1), 1, b"ab"), frames(&[b"a", b"b"]));
    }

    #[test]
    fn a_length_is_before_each_frame() {
        let lengths = |bytes| of(Framing::Length, 4, bytes);
        let right = b"\0\0\0\x03abc\0\0\0\0\0\0\0\x04\0\0\0\x01\0\0\0\x02x";
        assert_eq!(lengths(right), frames(&[b"abc", b"", b"\0\0\0\x01"]));
        let long = b"\0\0\0\x05abcde\0\0\0\x01f\xff\xff\xff\xff\0\0\0\x01g";
        assert_eq!(lengths(long), [TooLong, Frame(b"f".to_vec()), TooLong]);
    }

    fn images(bytes: &[u8]) -> Vec<Found> {
        of(Framing::Jpeg, LONGEST, bytes)
    }

    #[test]
    fn images_are_whole_wherever_the_output_is_cut() {
        // The end of the small image within the first is not the end of the first.
        let ends = |image: &[u8]| image.windows(2).filter(|pair| *pair == [0xff, EOI]).count();
        assert_eq!((ends(THUMBNAIL), ends(PROGRESSIVE)), (2, 1));
        let header = b"\r\n--frame\r\nContent-Type: image/jpeg\r\n\r\n";
        let found = images(&[THUMBNAIL, header, PROGRESSIVE, SMALL, b"\0\xff", SMALL].concat());
        assert!(found == frames(&[THUMBNAIL, PROGRESSIVE, SMALL, SMALL]));
    }

    #[test]
    fn a_damaged_image_is_dropped_and_the_next_one_is_not() {
        let next = Frame(SMALL.to_vec());
        let with_next = |begin: &[u8]| images(&[begin, SMALL].concat());
        // It breaks off in its data.
        let broken = &PROGRESSIVE[..PROGRESSIVE.len() - 50];
        assert_eq!(with_next(broken), [NotJpeg, next.clone()]);
        let gap = vec![b'.'; GAP];
        assert_eq!(with_next(&gap), frames(&[SMALL]));
        assert_eq!(
            with_next(&[&gap[..], b"."].concat()),
            [NotJpeg, next.clone()]
        );
        // A start without a marker, and a segment that is shorter than its own length.
        assert_eq!(with_next(b"\xff\xd8.."), [NotJpeg, next.clone()]);
        assert_eq!(
            with_next(b"\xff\xd8\xff\xe0\0\x01"),
            [NotJpeg, next.clone()]
        );
        assert_eq!(
            with_next(b"\xff\xd8\xff\xd8\xff\xd8.."),
            [NotJpeg, NotJpeg, NotJpeg, next]
        );
    }

    #[test]
    fn an_image_without_an_end_takes_no_more_memory_than_the_limit() {
        let image = |length| {
            let head: &[u8] = b"\xff\xd8\xff\xda\0\x02";
            [head, &vec![b'.'; length - head.len() - 2], &[0xff, EOI]].concat()
        };
        let all = [image(LONGEST), image(LONGEST + 1), image(100)].concat();
        assert_eq!(
            images(&all),
            [Frame(image(LONGEST)), TooLong, Frame(image(100))]
        );
        let mut splitter = Splitter::new(Framing::Jpeg, LONGEST);
        let mut found = Vec::new();
        push(&mut splitter, b"\xff\xd8\xff\xda\0\x02", &mut found);
        for _ in 0..1000 {
            push(&mut splitter, &[0; 1000], &mut found);
        }
        assert_eq!(found, [TooLong]);
        push(&mut splitter, SMALL, &mut found);
        assert_eq!(found.last(), Some(&Frame(SMALL.to_vec())));
    }

    #[test]
    fn any_output_is_cut_as_if_it_came_at_once() {
        let mut garbage = Garbage::new(17);
        for round in 0..300 {
            // Markers are frequent, lengths are small.
            let often = [
                0xff, 0xff, 0xd8, 0xd9, 0xda, 0xe0, 0, 0, 0, 3, 9, b'\n', b'x',
            ];
            let bytes: Vec<u8> = (0..120)
                .map(|_| often[garbage.below(often.len())])
                .collect();
            let framings = [
                Framing::Line,
                Framing::Jpeg,
                Framing::Length,
                Framing::Fixed(7),
            ];
            of(framings[round % 4], 12, &bytes);
        }
    }
}
