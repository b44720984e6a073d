//! Publish and subscribe: what flows, such as sensor values, rather than ends, such as tasks. `docs/streams.md` describes
//! the messages.
//!
//! ```
//! use std::time::Duration;
//! use ztl_std::{Publisher, Subscriber};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let publisher = Publisher::bind("tcp://127.0.0.1:*", "/battery")?;
//! let mut subscriber = Subscriber::connect(publisher.endpoint(), "/battery")?;
//! // A state: who subscribes later gets the newest one.
//! publisher.publish_state("/", &12.4.into());
//! let heard = subscriber.next_within(Duration::from_secs(5))?.expect("a message");
//! assert_eq!(heard.topic, "/battery/");
//! assert_eq!(heard.value()?.value().as_f64(), Some(12.4));
//! # Ok(())
//! # }
//! ```

mod publisher;
mod subscriber;
#[cfg(test)]
mod tests;

pub use publisher::{Publisher, PublisherBuilder};
pub use subscriber::{Content, Heard, Subscriber, SubscriberBuilder};

/// The path of messages that have no other, like the original's.
pub const PATH: &str = "/";
