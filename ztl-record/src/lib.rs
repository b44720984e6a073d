//! Recordings of streams and tasks: MCAP files, which Foxglove and PyPI's `mcap` read. No sockets: the caller brings
//! messages, and publishes them again.
//!
//! ```
//! use std::time::Instant;
//! use ztl_pickle::Pickle;
//! use ztl_record::{Content, Formats, Reader, Recording, Source};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let directory = std::env::temp_dir().join(format!("ztl-record-doc-{}", std::process::id()));
//! # std::fs::create_dir_all(&directory)?;
//! # let path = directory.join("run.mcap");
//! let mut recording = Recording::create(&path)?;
//! let robot = Source::named("robot");
//! let message = Formats::default().prepare(&robot, "/battery/", &Pickle::from(12.4).to_bytes())?;
//! recording.write(&robot, message, Instant::now())?;
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
mod mcap_format;
mod plain;
mod prepare;
mod reader;
mod report;
mod source;
mod task;
mod writer;

pub use prepare::{Formats, Message, RUN, SoundFormat};
pub use reader::{Content, Damage, Read, Reader};
pub use report::Drawn;
pub use source::Source;
pub use task::{TASKS, TaskEvent};
pub use writer::{Recording, Written};

#[cfg(test)]
mod tests;
