//! Signatures: texts that say which type a value has, as `(s[f]b)`.

use std::fmt;
use std::sync::Arc;

/// A type of values.
#[derive(Debug, Clone, PartialEq)]
pub enum Signature {
    /// `v` and `_`: no value, which takes no bytes.
    Void,
    /// `b`
    Bool,
    /// `c w i l`, and unsigned `C W I L`
    Integer {
        /// 1, 2, 4 or 8.
        bytes: u8,
        /// Whether it may be negative.
        signed: bool,
    },
    /// `f`, a number of 32 bits
    Float,
    /// `d`, a number of 64 bits
    Double,
    /// `s`
    Text,
    /// `r`: bytes
    Raw,
    /// `m`: any value, which is preceded by its signature
    Dynamic,
    /// `o`
    Object,
    /// `X` and `~`: values that cannot be sent
    Unknown,
    /// `[…]`, and `#…`, which is encoded in the same way
    List(Box<Signature>),
    /// `{……}`: the types of keys and values
    Map(Box<(Signature, Signature)>),
    /// `(…)<name,…>`
    Tuple(Tuple),
    /// `+…`: a value or nothing
    Optional(Box<Signature>),
}

/// The type of a tuple, also of a method's arguments.
#[derive(Debug, Clone, PartialEq)]
pub struct Tuple {
    /// The types of its fields.
    pub fields: Vec<Signature>,
    /// The names of its fields, or nothing.
    pub names: Names,
}

/// The names of a tuple's fields. There are none, or as many as fields.
pub type Names = Arc<[Box<str>]>;

/// Why a signature cannot be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SignatureError {
    /// The byte at which it is malformed.
    pub at: usize,
    /// What was expected there.
    pub expected: &'static str,
}

impl fmt::Display for SignatureError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "byte {}: expected {}", self.at, self.expected)
    }
}

impl std::error::Error for SignatureError {}

impl Signature {
    /// Parses a signature with at most `depth` levels.
    ///
    /// # Errors
    /// [`SignatureError`] if it is malformed or nested too deep.
    pub fn parse(text: &str, depth: usize) -> Result<Self, SignatureError> {
        let mut parser = Parser { text, at: 0 };
        let signature = parser.element(depth)?;
        match parser.peek() {
            None => Ok(signature),
            Some(_) => Err(parser.expected("the end")),
        }
    }
}

/// What a value must be, in words.
impl fmt::Display for Signature {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Void => f.write_str("nothing"),
            Self::Bool => f.write_str("True or False"),
            Self::Integer { .. } => f.write_str("an integer"),
            Self::Float | Self::Double => f.write_str("a number"),
            Self::Text => f.write_str("a text"),
            Self::Raw => f.write_str("bytes"),
            Self::Dynamic => f.write_str("any value"),
            Self::Object => f.write_str("an object, which cannot be given"),
            Self::Unknown => f.write_str("of an unknown type, which cannot be given"),
            Self::List(element) => match **element {
                Self::Bool => f.write_str("a list of True or False"),
                Self::Integer { .. } => f.write_str("a list of integers"),
                Self::Float | Self::Double => f.write_str("a list of numbers"),
                Self::Text => f.write_str("a list of texts"),
                Self::List(_) => f.write_str("a list of lists"),
                _ => f.write_str("a list"),
            },
            Self::Map(_) => f.write_str("a mapping"),
            Self::Tuple(Tuple { fields, names }) if names.is_empty() => {
                write!(f, "a list of {} values", fields.len())
            }
            Self::Tuple(Tuple { names, .. }) => write!(f, "a mapping with {}", names.join(", ")),
            Self::Optional(inner) => write!(f, "{inner}, or nothing"),
        }
    }
}

struct Parser<'t> {
    text: &'t str,
    at: usize,
}

impl Parser<'_> {
    fn peek(&self) -> Option<u8> {
        self.text.as_bytes().get(self.at).copied()
    }

    fn expected(&self, expected: &'static str) -> SignatureError {
        SignatureError {
            at: self.at,
            expected,
        }
    }

    fn close(&mut self, byte: u8, expected: &'static str) -> Result<(), SignatureError> {
        if self.peek() != Some(byte) {
            return Err(self.expected(expected));
        }
        self.at += 1;
        Ok(())
    }

    fn element(&mut self, depth: usize) -> Result<Signature, SignatureError> {
        let depth = depth
            .checked_sub(1)
            .ok_or_else(|| self.expected("fewer levels"))?;
        let byte = self.peek().ok_or_else(|| self.expected("a type"))?;
        let integer = |bytes| Signature::Integer {
            bytes,
            signed: byte.is_ascii_lowercase(),
        };
        let start = self.at;
        self.at += 1;
        let mut signature = match byte {
            b'v' | b'_' => Signature::Void,
            b'b' => Signature::Bool,
            b'c' | b'C' => integer(1),
            b'w' | b'W' => integer(2),
            b'i' | b'I' => integer(4),
            b'l' | b'L' => integer(8),
            b'f' => Signature::Float,
            b'd' => Signature::Double,
            b's' => Signature::Text,
            b'r' => Signature::Raw,
            b'm' => Signature::Dynamic,
            b'o' => Signature::Object,
            b'X' => Signature::Unknown,
            b'[' => {
                let element = Box::new(self.element(depth)?);
                self.close(b']', "']'")?;
                Signature::List(element)
            }
            b'#' => Signature::List(Box::new(self.element(depth)?)),
            b'~' => {
                self.element(depth)?;
                Signature::Unknown
            }
            b'+' => Signature::Optional(Box::new(self.element(depth)?)),
            b'{' => {
                let entry = Box::new((self.element(depth)?, self.element(depth)?));
                self.close(b'}', "'}'")?;
                Signature::Map(entry)
            }
            b'(' => {
                let mut fields = Vec::new();
                while self.peek() != Some(b')') {
                    fields.push(self.element(depth)?);
                }
                self.at += 1;
                let names = Names::default();
                Signature::Tuple(Tuple { fields, names })
            }
            _ => {
                self.at = start;
                return Err(self.expected("a type"));
            }
        };
        if self.peek() == Some(b'<') {
            let annotation = self.annotation()?;
            if let Signature::Tuple(tuple) = &mut signature {
                // The first is the tuple's own name.
                let names: Vec<Box<str>> = annotation.split(',').skip(1).map(Box::from).collect();
                if names.len() == tuple.fields.len() {
                    tuple.names = names.into();
                }
            }
        }
        Ok(signature)
    }

    /// The text between `<` and the `>` that closes it.
    fn annotation(&mut self) -> Result<&str, SignatureError> {
        let start = self.at + 1;
        let mut open = 0_usize;
        while let Some(byte) = self.peek() {
            match byte {
                b'<' => open += 1,
                b'>' => open -= 1,
                _ => {}
            }
            self.at += 1;
            if open == 0 {
                return Ok(self.text.get(start..self.at - 1).unwrap_or_default());
            }
        }
        Err(self.expected("'>'"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn error(text: &str) -> String {
        Signature::parse(text, 32).unwrap_err().to_string()
    }

    #[test]
    fn every_type_is_read() {
        for text in [
            "v",
            "(bcCwWiIlLfdsrmoX_)",
            "[[f]]",
            "{s[(if)<Point,a,b>]}",
            "()",
            "#m",
            "~m",
            "+s",
            "(ss)<Name,with<T>,b>",
            "{I(Iss)<MetaSignal,uid,name,signature>}",
        ] {
            Signature::parse(text, 32).expect(text);
        }
        let Ok(Signature::Tuple(tuple)) = Signature::parse("(If)<Touch,uid,force>", 32) else {
            panic!("not a tuple");
        };
        assert_eq!(tuple.names.join(" "), "uid force");
    }

    #[test]
    fn a_malformed_signature_is_an_error_at_its_byte() {
        assert_eq!(error(""), "byte 0: expected a type");
        assert_eq!(error("(s"), "byte 2: expected a type");
        assert_eq!(error("[ss]"), "byte 2: expected ']'");
        assert_eq!(error("{s}"), "byte 2: expected a type");
        assert_eq!(error("ss"), "byte 1: expected the end");
        assert_eq!(error("(s)<a"), "byte 5: expected '>'");
        assert_eq!(error("(*)"), "byte 1: expected a type");
        assert_eq!(error("ä"), "byte 0: expected a type");
        assert_eq!(error(&"[".repeat(33)), "byte 32: expected fewer levels");
    }
}
