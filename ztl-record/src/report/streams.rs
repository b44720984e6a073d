//! The streams of a recording, reduced to what is drawn.

use std::collections::BTreeMap;

use ztl_pickle::{Kind, Value};

use super::series::Series;
use super::span::Span;
use crate::prepare::SoundFormat;
use crate::reader::{Content, Read};

/// Most streams that are drawn.
const STREAMS: usize = 60;
/// Most lines of a stream: the numbers of one value.
const LINES: usize = 6;
/// Deepest nesting of a number in a value.
const DEPTH: usize = 3;
/// Most texts that are marked in a stream.
const MARKS: usize = 200;
/// Longest text of a mark in bytes.
const MARK: usize = 200;
/// Most images of a stream, spread over the time.
pub(super) const IMAGES: u64 = 7;
/// Longest image that is drawn, and of all together, in bytes.
const IMAGE: usize = 1 << 20;
const ALL_IMAGES: usize = 16 << 20;

/// All streams, by topic and publisher.
pub(super) struct Streams {
    span: Span,
    pub(super) shown: BTreeMap<(String, String), Stream>,
    /// Messages of streams that are not drawn.
    pub(super) hidden: u64,
    /// Bytes of all images.
    image_bytes: usize,
}

/// A stream.
#[derive(Default)]
pub(super) struct Stream {
    pub(super) messages: u64,
    /// Numbers, by their place in the value.
    pub(super) lines: BTreeMap<String, Series>,
    pub(super) sound: Option<(SoundFormat, Series)>,
    /// Time and JPEG.
    pub(super) images: Vec<(u64, Vec<u8>)>,
    /// When there is room for the next image.
    next: u64,
    pub(super) marks: Vec<(u64, String)>,
}

impl Streams {
    pub(super) const fn new(span: Span) -> Self {
        Self {
            span,
            shown: BTreeMap::new(),
            hidden: 0,
            image_bytes: 0,
        }
    }

    pub(super) fn on_message(&mut self, read: &Read) {
        let key = (read.topic.clone(), read.source.name.clone());
        if self.shown.len() >= STREAMS && !self.shown.contains_key(&key) {
            self.hidden += 1;
            return;
        }
        let (span, at) = (self.span, read.log_time);
        let stream = self.shown.entry(key).or_default();
        stream.messages += 1;
        match &read.content {
            Content::Run(_) | Content::Task(..) => {}
            Content::Value(pickle) => stream.on_value(span, at, pickle.value()),
            Content::Text(text) => match text.trim().parse() {
                Ok(number) => stream.on_number(span, at, "", number),
                Err(_) => stream.on_mark(at, text),
            },
            Content::Sound(format, bytes) => stream.on_sound(span, at, *format, bytes),
            Content::Image(bytes) => {
                let room = ALL_IMAGES.saturating_sub(self.image_bytes).min(IMAGE);
                self.image_bytes += stream.on_image(span, at, bytes, room);
            }
            Content::Bytes(bytes) => stream.on_mark(at, &format!("{} bytes", bytes.len())),
        }
    }
}

impl Stream {
    fn on_value(&mut self, span: Span, at: u64, value: Value<'_>) {
        if !self.on_numbers(span, at, "", value, DEPTH) {
            match value.as_str() {
                Some(text) => self.on_mark(at, text),
                None if self.marks.len() < MARKS => {
                    let text = value.to_json(MARK);
                    self.on_mark(at, text.as_deref().unwrap_or("a long value"));
                }
                None => {}
            }
        }
    }

    /// Adds the numbers in a value. Returns whether there are any.
    fn on_numbers(
        &mut self,
        span: Span,
        at: u64,
        place: &str,
        value: Value<'_>,
        depth: usize,
    ) -> bool {
        let below = |key: &str| match place {
            "" => key.to_owned(),
            place => format!("{place}.{key}"),
        };
        match (value.kind(), depth.checked_sub(1)) {
            (Kind::Int(_) | Kind::Float(_) | Kind::Scalar(_) | Kind::Bool(_), _) => {
                let number = match value.kind() {
                    Kind::Bool(value) => Some(f64::from(value)),
                    _ => value.as_f64(),
                };
                if let Some(number) = number {
                    self.on_number(span, at, place, number);
                }
                number.is_some()
            }
            (Kind::List(items) | Kind::Tuple(items), Some(depth)) => {
                let mut any = false;
                for (nth, item) in items.into_iter().enumerate().take(LINES) {
                    any |= self.on_numbers(span, at, &below(&nth.to_string()), item, depth);
                }
                any
            }
            (Kind::Dict(entries) | Kind::OrderedDict(entries), Some(depth)) => {
                let mut any = false;
                // Many keys would take long for each message.
                for (key, value) in entries.into_iter().take(64) {
                    match key.as_str() {
                        None | Some("time" | "stamp" | "timestamp") => {}
                        Some(key) => any |= self.on_numbers(span, at, &below(key), value, depth),
                    }
                }
                any
            }
            _ => false,
        }
    }

    fn on_number(&mut self, span: Span, at: u64, place: &str, number: f64) {
        if let Some(series) = self.lines.get_mut(place) {
            series.add(span, at, number);
        } else if self.lines.len() < LINES {
            let mut series = Series::new();
            series.add(span, at, number);
            self.lines.insert(place.to_owned(), series);
        }
    }

    fn on_mark(&mut self, at: u64, text: &str) {
        if self.marks.len() < MARKS {
            let text = text.get(..text.floor_char_boundary(MARK)).unwrap_or(text);
            self.marks.push((at, text.to_owned()));
        }
    }

    /// A block of samples, of which the last one was recorded now.
    fn on_sound(&mut self, span: Span, at: u64, format: SoundFormat, bytes: &[u8]) {
        let (_, series) = self.sound.get_or_insert_with(|| (format, Series::new()));
        let samples = bytes.as_chunks::<2>().0;
        let rate = f64::from(format.rate.max(1)) * f64::from(format.channels.max(1));
        for (nth, sample) in samples.iter().enumerate() {
            let before = (samples.len() - nth) as f64 / rate * 1e9;
            let at = at.saturating_sub(before as u64).max(span.from);
            series.add(span, at, f64::from(i16::from_le_bytes(*sample)));
        }
    }

    /// Keeps an image if there is room for it beside the one before. Returns its bytes that are kept.
    fn on_image(&mut self, span: Span, at: u64, bytes: &[u8], room: usize) -> usize {
        let width = span.length() / IMAGES;
        let is_last = at.saturating_add(width) > span.to && !self.images.is_empty();
        if at < self.next || is_last || bytes.len() > room {
            return 0;
        }
        self.next = at.saturating_add(width);
        self.images.push((at, bytes.to_vec()));
        bytes.len()
    }
}
