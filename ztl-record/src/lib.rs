//! Recordings of streams and tasks: MCAP files, which Foxglove and PyPI's `mcap` read. No sockets: the caller brings
//! messages, and publishes them again.
//!
//! ```
//! use std::time::Instant;
//! use ztl_pickle::Pickle;
//! use ztl_record::{Content, Formats, Reader, Recording};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let directory = std::env::temp_dir().join(format!("ztl-record-doc-{}", std::process::id()));
//! # std::fs::create_dir_all(&directory)?;
//! # let path = directory.join("run.mcap");
//! let mut recording = Recording::create(&path)?;
//! let message = Formats::default().prepare("/battery/", &Pickle::from(12.4).to_bytes())?;
//! recording.write("robot", message, Instant::now())?;
//! recording.finish()?;
//!
//! let read: Vec<_> = Reader::open(&path)?.collect();
//! assert_eq!(read[0].topic, "/battery/");
//! assert!(matches!(&read[0].content, Content::Value(value) if value.value().as_f64() == Some(12.4)));
//! # std::fs::remove_dir_all(directory)?;
//! # Ok(())
//! # }
//! ```
//!
//! `docs/recording.md` describes the files.

mod form;
mod plain;
mod prepare;
mod reader;
mod report;
mod task;
mod writer;

pub use prepare::{Formats, Message, SoundFormat};
pub use reader::{Content, Damage, Read, Reader};
pub use report::report;
pub use task::{TASKS, TaskEvent};
pub use writer::{Recording, Written};

#[cfg(test)]
mod tests;
