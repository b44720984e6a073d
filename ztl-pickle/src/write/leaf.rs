//! How values without items are written.

use super::{Known, Writer};
use crate::dtype::ElementKind;
use crate::global::Global;
use crate::graph::{Chain, Node, Ref, Span};
use crate::integer;

impl Writer<'_> {
    /// A value without items, for which a mention may be shorter.
    pub(super) fn leaf(&mut self, node: Node) {
        match node {
            Node::BigInt(span) => self.long(self.graph.bytes(span)),
            Node::Str(span) => self.text(self.graph.bytes(span)),
            Node::Bytes(span) => self.bytes(span),
            Node::ByteArray(span) if span.len == 0 => {
                self.global(Global::ByteArray);
                self.out.extend(b")R");
            }
            Node::ByteArray(span) => {
                self.global(Global::ByteArray);
                self.latin1(span);
                self.text(b"latin-1");
                self.out.extend([0x86, b'R']);
            }
            Node::DType(dtype) => {
                self.global(Global::DType);
                self.text(dtype.short_code().as_bytes());
                // Not aligned, but a copy; then version and byte order.
                self.out.extend([0x89, 0x88, 0x87, b'R', b'(', b'K', 3]);
                self.text(dtype.order().to_string().as_bytes());
                self.out.extend(b"NNN");
                let (size, alignment, flags) = match dtype.kind() {
                    ElementKind::Bytes => (dtype.size() as i64, 1, 0),
                    ElementKind::Text => (dtype.size() as i64, 4, 8),
                    _ => (-1, -1, 0),
                };
                for part in [size, alignment, flags] {
                    self.int(part);
                }
                self.out.extend(b"tb");
            }
            Node::Array {
                fortran,
                dtype,
                shape,
                data,
            } => {
                self.global(Global::Reconstruct);
                self.global(Global::NdArray);
                self.out.extend([b'K', 0, 0x85]);
                self.encoded(|writer| writer.text(b"b"));
                self.out.extend([0x87, b'R', b'(', b'K', 1, b'(']);
                let shape = self.graph.node(shape).chain().unwrap_or(Chain::EMPTY);
                for length in self.graph.iter(shape) {
                    self.value(length);
                }
                self.out.push(b't');
                self.value(dtype);
                self.out.push(if fortran { 0x88 } else { 0x89 });
                self.data(data);
                self.out.extend(b"tb");
            }
            Node::Scalar { dtype, data } => {
                self.global(Global::Scalar);
                self.value(dtype);
                self.data(data);
                self.out.extend([0x86, b'R']);
            }
            Node::Date { state } => self.time(Global::Date, state, 4, Ref::NONE),
            Node::Time { state, zone } => self.time(Global::Time, state, 6, zone),
            Node::DateTime { state, zone } => self.time(Global::DateTime, state, 10, zone),
            Node::Delta {
                days,
                seconds,
                micros,
            } => {
                self.global(Global::Delta);
                for part in [days.into(), seconds.into(), micros.into()] {
                    self.int(part);
                }
                self.out.extend([0x87, b'R']);
            }
            Node::Zone { delta, name } => {
                self.global(Global::Zone);
                self.value(delta);
                if name == Ref::NONE {
                    self.out.push(0x85);
                } else {
                    self.value(name);
                    self.out.push(0x86);
                }
                self.out.push(b'R');
            }
            // Written where they appear.
            _ => {}
        }
    }

    pub(super) fn int(&mut self, value: i64) {
        if let Ok(value) = u8::try_from(value) {
            self.out.extend([b'K', value]);
        } else if let Ok(value) = u16::try_from(value) {
            self.out.push(b'M');
            self.out.extend(value.to_le_bytes());
        } else if let Ok(value) = i32::try_from(value) {
            self.out.push(b'J');
            self.out.extend(value.to_le_bytes());
        } else {
            self.long(integer::shortest(&value.to_le_bytes()));
        }
    }

    fn long(&mut self, bytes: &[u8]) {
        match u8::try_from(bytes.len()) {
            Ok(len) => self.out.extend([0x8a, len]),
            Err(_) => {
                self.out.push(0x8b);
                self.out.extend((bytes.len() as u32).to_le_bytes());
            }
        }
        self.out.extend(bytes);
    }

    fn text(&mut self, text: &[u8]) {
        self.out.push(b'X');
        self.out.extend((text.len() as u32).to_le_bytes());
        self.out.extend(text);
    }

    /// Bytes as a text with the same codes.
    fn latin1(&mut self, Span { start, len }: Span) {
        if self.mention(&Known::Text(start, len)) {
            return;
        }
        let bytes = self.graph.bytes(Span { start, len });
        let text: String = bytes.iter().copied().map(char::from).collect();
        self.text(text.as_bytes());
        // A short one is hardly longer than its mention.
        if len > 8 {
            self.put(Known::Text(start, len));
        }
    }

    /// Bytes that Python 2 and 3 both read as bytes: Python 3's own way.
    fn bytes(&mut self, span: Span) {
        if span.len == 0 {
            self.global(Global::Bytes);
            return self.out.extend(b")R");
        }
        self.encoded(|writer| writer.latin1(span));
    }

    fn encoded(&mut self, text: impl FnOnce(&mut Self)) {
        self.global(Global::Encode);
        text(self);
        if !self.mention(&Known::Latin1) {
            self.text(b"latin1");
            self.put(Known::Latin1);
        }
        self.out.extend([0x86, b'R']);
    }

    /// The bytes of elements.
    fn data(&mut self, data: Ref) {
        match self.graph.node(data) {
            Node::Bytes(span) | Node::ByteArray(span) | Node::Str(span) => self.bytes(span),
            _ => {}
        }
    }

    fn time(&mut self, global: Global, start: u32, len: u32, zone: Ref) {
        self.global(global);
        self.bytes(Span { start, len });
        if zone == Ref::NONE {
            self.out.push(0x85);
        } else {
            self.value(zone);
            self.out.push(0x86);
        }
        self.out.push(b'R');
    }
}
