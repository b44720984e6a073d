//! Decodes firmware's defmt log from the link, with the firmware's ELF file.
//!
//! `defmt-decoder` does the same for debuggers. It is not used here because it allocates as much as a damaged
//! stream or a foreign file asks for, and enables a feature of `serde_json` that changes parsing in the whole
//! process.

mod args;
mod decoder;
mod message;
mod table;
mod text;

pub use decoder::{Decoder, Malformed};
pub use message::{Level, Message};
pub use table::ElfError;
