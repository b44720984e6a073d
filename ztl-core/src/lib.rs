//! The ZTL task protocol without `std` and without an allocator.
//!
//! A *client* says INIT with a `handler:component:goal`, gets a task id, asks STATUS, may say ABORT.
//! This crate holds every rule of that conversation; it knows no socket, no clock and no thread.
//! Bytes, events and the time come in as arguments, answers and wake-up times come out.
//!
//! | room | what it holds |
//! |---|---|
//! | [`lifecycle`] | the six task states, the three requests, and which event leads where |
//! | [`message`] | the text on the wire: `scope;state;id;payload` |
//! | [`spec`] | what a client asks for: `handler:component:goal`, in base64 |
//! | [`repr`] | text quoted as Python's `repr` does, which the original puts in its replies |
//! | [`dispatcher`] | a server's rules: a request in, an answer or an action out |
//! | [`client`] | a client's rules: which answer is whose, and what no answer means |
//! | [`envelope`] | who asks, and which of its requests it is |
//! | [`tasks`] | what is remembered of tasks, with or without a heap |
//! | [`memory`], [`reply`] | what else a dispatcher remembers, and what it answers |
//! | [`link`] | frames and messages between a gateway and a microcontroller |
//!
//! ```
//! use ztl_core::{message::Message, lifecycle::{Event, State}};
//!
//! let request = Message::parse(b"/test;2;7;status update").unwrap();
//! assert_eq!((request.scope, request.payload), ("/test", "status update"));
//!
//! // A final state absorbs whatever comes later.
//! assert_eq!(State::Accepted.after(Event::Complete), Some(State::Completed));
//! assert_eq!(State::Completed.after(Event::Abort), None);
//! ```
#![no_std]

#[cfg(test)]
extern crate std;

pub mod base64;
pub mod client;
pub mod dispatcher;
pub mod envelope;
pub mod integer;
pub mod lifecycle;
pub mod link;
pub mod memory;
pub mod message;
pub mod reply;
pub mod repr;
pub mod sink;
pub mod spec;
pub mod tasks;
pub mod time;

pub use lifecycle::{Event, Request, State};
pub use message::Message;
pub use spec::TaskSpec;
pub use time::Instant;

/// Version of this crate, told by `$ztl`.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");

/// The number a server gives to a task it took, from 1 to `u32::MAX`; unique for the server's life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TaskId(core::num::NonZeroU32);

impl TaskId {
    /// The id with this number, or `None` for 0, which on the wire means "not accepted".
    #[must_use]
    pub const fn new(number: u32) -> Option<Self> {
        match core::num::NonZeroU32::new(number) {
            Some(number) => Some(Self(number)),
            None => None,
        }
    }

    /// The number as it goes over the wire.
    #[must_use]
    pub const fn get(self) -> u32 {
        self.0.get()
    }

    /// The id after this one, or `None` when the numbers are used up: an id is never given twice.
    #[must_use]
    pub fn next(self) -> Option<Self> {
        self.0.checked_add(1).map(Self)
    }
}

impl core::fmt::Display for TaskId {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        self.get().fmt(f)
    }
}
