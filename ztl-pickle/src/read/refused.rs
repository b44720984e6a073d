//! What is said about operations that are always refused.

use super::Reader;
use crate::Error;
use crate::graph::Node;
use crate::input::malformed;

impl Reader<'_> {
    /// Operations that only make objects.
    pub(super) fn refused(&mut self, operation: u8) -> Error {
        let what = match operation {
            b'o' | 0x81 | 0x92 => {
                let depth = match operation {
                    b'o' => self.marks.last().map(|height| height as usize),
                    0x81 => self.stack.len().checked_sub(2),
                    _ => self.stack.len().checked_sub(3),
                };
                let class = depth.and_then(|depth| self.stack.get(depth));
                match class.map(|class| self.graph.node(class)) {
                    Some(Node::Global(global)) => return global.refused(),
                    _ => "an object",
                }
            }
            b'P' => {
                return match self.input.line() {
                    Ok(id) => Error::refused(b"", &[b"persistent id ", id].concat()),
                    Err(error) => error,
                };
            }
            b'Q' => "persistent id",
            0x82..=0x84 => "extension code",
            0x97 | 0x98 => "out-of-band buffer",
            _ => return malformed("an unknown operation"),
        };
        Error::refused(b"", what.as_bytes())
    }
}
