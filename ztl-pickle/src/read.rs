//! The machine that a pickle's operations drive: a stack, marks, and a memo.

mod refused;

use crate::calls;
use crate::chunks::Chunks;
use crate::finish::finish;
use crate::global::Global;
use crate::graph::{Chain, Graph, MAX_BYTES, Node, Ref};
use crate::input::{Input, is_text, malformed, raw_unicode, unescape};
use crate::limits::{Account, Limits};
use crate::memo::Memo;
use crate::{Error, integer};

/// Reads a pickle: its graph, and the value in it.
pub(crate) fn read(bytes: &[u8], limits: &Limits) -> Result<(Graph, Ref), Error> {
    let most = limits.bytes.min(MAX_BYTES);
    if bytes.len() > most {
        let limit = "bytes";
        return Err(Error::TooLarge { limit, most });
    }
    let mut reader = Reader {
        input: Input::new(bytes),
        graph: Graph::new(limits.nodes),
        stack: Chunks::new(),
        marks: Chunks::new(),
        memo: Memo::new(limits.memo),
        account: Account::new(limits, bytes.len()),
    };
    let root = reader.run().map_err(|error| match error {
        Error::Malformed { at: 0, what } => {
            let at = reader.input.at();
            Error::Malformed { at, what }
        }
        error => error,
    })?;
    let (mut graph, mut account) = reader.end();
    finish(&mut graph, root, limits, bytes.len(), &mut account)?;
    Ok((graph, root))
}

struct Reader<'a> {
    input: Input<'a>,
    graph: Graph,
    stack: Chunks<Ref>,
    /// The heights of the stack.
    marks: Chunks<u32>,
    memo: Memo,
    account: Account,
}

impl Reader<'_> {
    /// Frees what only reading needs.
    fn end(mut self) -> (Graph, Account) {
        let freed = [
            self.stack.allocated(),
            self.marks.allocated(),
            self.memo.allocated(),
        ];
        self.account.release(freed.iter().sum());
        (self.graph, self.account)
    }

    /// Performs operations until the last one.
    fn run(&mut self) -> Result<Ref, Error> {
        loop {
            let operation = self.input.u8()?;
            match operation {
                b'.' => return self.pop(),
                b'(' => self
                    .marks
                    .push(self.stack.len() as u32, &mut self.account)?,
                b'0' => self.discard()?,
                b'1' => {
                    let height = self.mark()?;
                    self.stack.truncate(height);
                }
                b'2' => self.push(self.top()?)?,
                0x80 => {
                    if self.input.u8()? > 5 {
                        return Err(malformed("an unknown protocol"));
                    }
                }
                0x95 => {
                    let len = self.input.u64()?;
                    self.input.expect(len)?;
                }
                b'N' => self.push(Ref::NONE)?,
                0x88 => self.push(Ref::TRUE)?,
                0x89 => self.push(Ref::FALSE)?,
                b'I' | b'L' | b'F' | b'S' | b'V' => self.line(operation)?,
                b'J' => {
                    let value = i32::from_le_bytes(self.input.array()?);
                    self.int(value.into())?;
                }
                b'K' => {
                    let value = self.input.u8()?;
                    self.int(value.into())?;
                }
                b'M' => {
                    let value = u16::from_le_bytes(self.input.array()?);
                    self.int(value.into())?;
                }
                0x8a => {
                    let len = self.input.u8()?;
                    self.long(len.into())?;
                }
                0x8b => {
                    let len = self.input.signed_len()?;
                    self.long(len)?;
                }
                b'G' => {
                    let value = f64::from_be_bytes(self.input.array()?);
                    self.add(Node::Float(value))?;
                }
                b'U' | b'C' | 0x8c => {
                    let len = self.input.u8()?;
                    self.string(operation, len.into())?;
                }
                b'T' => {
                    let len = self.input.signed_len()?;
                    self.string(operation, len)?;
                }
                b'B' | b'X' => {
                    let len = self.input.u32()?;
                    self.string(operation, len.into())?;
                }
                0x8d | 0x8e | 0x96 => {
                    let len = self.input.u64()?;
                    self.string(operation, len)?;
                }
                b']' => self.add(Node::List(Chain::EMPTY))?,
                b'}' => self.add(Node::Dict(Chain::EMPTY))?,
                0x8f => self.add(Node::Set(Chain::EMPTY))?,
                b')' => self.push(Ref::EMPTY_TUPLE)?,
                b'l' | b'd' | b't' | 0x91 => {
                    let height = self.mark()?;
                    self.collect(operation, height)?;
                }
                0x85..=0x87 => {
                    let height = self.below(usize::from(operation - 0x84))?;
                    self.collect(b't', height)?;
                }
                b'a' => {
                    let height = self.below(1)?;
                    self.extend(b'a', height)?;
                }
                b's' => {
                    let height = self.below(2)?;
                    self.extend(b's', height)?;
                }
                b'e' | b'u' | 0x90 => {
                    let height = self.mark()?;
                    self.extend(operation, height)?;
                }
                b'g' | b'h' | b'j' => {
                    let index = self.memo_index(operation, b'g', b'h')?;
                    let unknown = malformed("an unknown memo entry");
                    let value = self.memo.get(index).ok_or(unknown)?;
                    self.push(value)?;
                }
                b'p' | b'q' | b'r' => {
                    let index = self.memo_index(operation, b'p', b'q')?;
                    let value = self.top()?;
                    self.memo.put(index, value, &mut self.account)?;
                }
                0x94 => {
                    let (index, value) = (self.memo.len(), self.top()?);
                    self.memo.put(index, value, &mut self.account)?;
                }
                b'c' | b'i' => {
                    let (module, name) = (self.input.line()?, self.input.line()?);
                    if operation == b'i' {
                        return Err(Error::refused(module, name));
                    }
                    self.add(Node::Global(Global::find(module, name)?))?;
                }
                0x93 => {
                    let (name, module) = (self.pop()?, self.pop()?);
                    let (Node::Str(module), Node::Str(name)) =
                        (self.graph.node(module), self.graph.node(name))
                    else {
                        return Err(malformed("a name that is not a string"));
                    };
                    let (module, name) = (self.graph.bytes(module), self.graph.bytes(name));
                    self.add(Node::Global(Global::find(module, name)?))?;
                }
                b'R' => self.reduce()?,
                b'b' => {
                    let (state, object) = (self.pop()?, self.top()?);
                    calls::build(&mut self.graph, object, state)?;
                }
                _ => return Err(self.refused(operation)),
            }
        }
    }

    /// The height of the stack that operations may not go below.
    fn fence(&self) -> usize {
        self.marks.last().unwrap_or(0) as usize
    }

    fn push(&mut self, value: Ref) -> Result<(), Error> {
        self.stack.push(value, &mut self.account)
    }

    fn add(&mut self, node: Node) -> Result<(), Error> {
        let value = self.graph.add(node, &mut self.account)?;
        self.push(value)
    }

    fn int(&mut self, value: i64) -> Result<(), Error> {
        let value = self.graph.int(value, &mut self.account)?;
        self.push(value)
    }

    fn top(&self) -> Result<Ref, Error> {
        let height = self.below(1)?;
        self.stack.get(height).ok_or(EMPTY)
    }

    fn pop(&mut self) -> Result<Ref, Error> {
        let value = self.top()?;
        self.stack.pop();
        Ok(value)
    }

    /// The height of the stack below its last `count` values.
    fn below(&self, count: usize) -> Result<usize, Error> {
        let height = self.stack.len().checked_sub(count);
        height.filter(|height| *height >= self.fence()).ok_or(EMPTY)
    }

    /// Removes the last mark; returns its height.
    fn mark(&mut self) -> Result<usize, Error> {
        let height = self.marks.pop().ok_or(malformed("no mark"))?;
        Ok(height as usize)
    }

    /// Removes the last value, or a mark.
    fn discard(&mut self) -> Result<(), Error> {
        let height = self.stack.len();
        match self.marks.last() {
            Some(mark) if mark as usize == height => drop(self.marks.pop()),
            _ => drop(self.pop()?),
        }
        Ok(())
    }

    fn memo_index(&mut self, operation: u8, text: u8, short: u8) -> Result<u64, Error> {
        if operation == short {
            return Ok(self.input.u8()?.into());
        }
        if operation != text {
            return Ok(self.input.u32()?.into());
        }
        let line = std::str::from_utf8(self.input.line()?).ok();
        let index = line.and_then(|line| line.parse().ok());
        index.ok_or(malformed("an invalid memo index"))
    }

    fn long(&mut self, len: u64) -> Result<(), Error> {
        let bytes = self.input.take(len)?;
        let value = self.graph.long(bytes, &mut self.account)?;
        self.push(value)
    }

    fn string(&mut self, operation: u8, len: u64) -> Result<(), Error> {
        let bytes = self.input.take(len)?;
        self.keep(operation, bytes)
    }

    /// Pushes bytes as the operation's type.
    fn keep(&mut self, operation: u8, bytes: &[u8]) -> Result<(), Error> {
        let is_text = match operation {
            b'X' | 0x8c | 0x8d | b'V' => match is_text(bytes) {
                true => true,
                false => return Err(malformed("text that is not UTF-8")),
            },
            // Python 2 does not tell text from bytes.
            b'S' | b'T' | b'U' => bytes.is_ascii(),
            _ => false,
        };
        let span = self.graph.keep(bytes, &mut self.account)?;
        self.add(match operation {
            0x96 => Node::ByteArray(span),
            _ if is_text => Node::Str(span),
            _ => Node::Bytes(span),
        })
    }

    /// The values of protocol 0.
    fn line(&mut self, operation: u8) -> Result<(), Error> {
        let line = self.input.line()?;
        match (operation, line) {
            (b'I', b"00") => self.push(Ref::FALSE),
            (b'I', b"01") => self.push(Ref::TRUE),
            (b'I' | b'L', digits) => {
                let digits = digits.strip_suffix(b"L").unwrap_or(digits);
                let wrong = malformed("an invalid integer");
                let bytes = integer::from_decimal(digits).ok_or(wrong)?;
                let value = self.graph.long(&bytes, &mut self.account)?;
                self.push(value)
            }
            (b'F', text) => {
                let text = std::str::from_utf8(text).ok();
                let value = text.and_then(|text| text.parse().ok());
                self.add(Node::Float(value.ok_or(malformed("an invalid float"))?))
            }
            (_, text) => {
                // Up to two bytes for each, in a vector that grows.
                let most = text.len().saturating_mul(3);
                self.account.charge(most)?;
                let decode = if operation == b'S' {
                    unescape
                } else {
                    raw_unicode
                };
                let bytes = decode(text)?;
                self.keep(operation, &bytes)?;
                self.account.release(most);
                Ok(())
            }
        }
    }

    /// Replaces the values above `height` by a collection of them.
    fn collect(&mut self, operation: u8, height: usize) -> Result<(), Error> {
        let mut chain = Chain::EMPTY;
        let mut index = height;
        while let Some(item) = self.stack.get(index) {
            self.graph.link(&mut chain, item, &mut self.account)?;
            index += 1;
        }
        self.stack.truncate(height);
        match operation {
            b't' if chain.len == 0 => self.push(Ref::EMPTY_TUPLE),
            b't' => self.add(Node::Tuple(chain)),
            b'l' => self.add(Node::List(chain)),
            b'd' if chain.len.is_multiple_of(2) => self.add(Node::Dict(chain)),
            b'd' => Err(malformed("a key without a value")),
            _ => self.add(Node::FrozenSet(chain)),
        }
    }

    /// Moves the values above `height` into the collection below.
    fn extend(&mut self, operation: u8, height: usize) -> Result<(), Error> {
        let below = height.checked_sub(1).filter(|below| *below >= self.fence());
        let to = below.and_then(|below| self.stack.get(below)).ok_or(EMPTY)?;
        let fits = match (operation, self.graph.node(to)) {
            (b'a' | b'e', Node::List(_)) | (0x90, Node::Set(_)) => true,
            (b's' | b'u', Node::Dict(_) | Node::OrderedDict(_)) => {
                (self.stack.len() - height).is_multiple_of(2)
            }
            _ => false,
        };
        if !fits {
            return Err(malformed("values that the collection cannot take"));
        }
        let mut index = height;
        while let Some(item) = self.stack.get(index) {
            self.graph.append(to, item, &mut self.account)?;
            index += 1;
        }
        self.stack.truncate(height);
        Ok(())
    }

    fn reduce(&mut self) -> Result<(), Error> {
        let (args, callable) = (self.pop()?, self.pop()?);
        let Node::Global(global) = self.graph.node(callable) else {
            return Err(malformed("a call of something else than a name"));
        };
        let args = calls::arguments(&self.graph, args)?;
        let value = calls::call(&mut self.graph, global, &args, &mut self.account)?;
        self.push(value)
    }
}

const EMPTY: Error = malformed("the stack is empty");
