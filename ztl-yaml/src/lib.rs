//! YAML files that people write. Each value has its place in the file, so that every mistake is shown where
//! it is, with its remedy, and all mistakes at once. Values are read exactly as PyYAML reads them.
//!
//! ```
//! use ztl_yaml::Document;
//!
//! let document = Document::parse("lab.yaml", b"port: 12345\nscpoe: /lab\n").unwrap();
//! let mut reading = document.reading();
//! let mut fields = reading.fields(document.root(), "a gateway").unwrap();
//! let port = fields.optional("port").and_then(|node| reading.whole::<u16>(node, "a port"));
//! fields.optional("scope");
//! fields.finish(&mut reading);
//! let mistakes = reading.finish(port).unwrap_err();
//! assert_eq!(mistakes.to_string(), "\
//! lab.yaml:2:1: unknown key 'scpoe'; did you mean 'scope'?
//!   2 | scpoe: /lab
//!     | ^^^^^
//! ");
//! ```

mod cursor;
mod diagnostic;
mod document;
mod flow;
mod merge;
mod node;
mod open_quote;
mod parse_errors;
mod parser;
pub mod python;
mod reading;
mod scanner;
mod texts;
mod token;

pub use diagnostic::{Diagnostic, Diagnostics, closest};
pub use document::Document;
pub use node::{CORE, Mark, Node, NodeValue, Rules, Span};
pub use reading::{Fields, Reading};

/// The longest file to read, in bytes.
pub const MAX_FILE: u64 = 1 << 20;

#[cfg(test)]
mod tests;
