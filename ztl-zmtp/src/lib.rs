//! ZMTP, the protocol between ZeroMQ sockets, without I/O.
//!
//! `docs/zmtp.md` cites the clause of the specification for each behaviour.
//!
//! | to | use |
//! |---|---|
//! | run one connection in firmware, in a buffer of a fixed size | [`Connection`], as a [`Rep`], [`Req`] or [`Dealer`] |
#![cfg_attr(
    feature = "alloc",
    doc = "| run one of many connections of a server or client | [`session`] |"
)]
#![no_std]

#[cfg(feature = "alloc")]
extern crate alloc;
#[cfg(test)]
extern crate std;

mod connection;
#[cfg(feature = "curve")]
pub mod curve;
mod fault;
mod message;
mod receive;
#[cfg(feature = "alloc")]
pub mod session;
mod wire;

pub use connection::Connection;
pub use fault::Fault;
pub use message::{Content, Frames, Message, envelope};
pub use wire::{
    Dealer, GREETING, HANDSHAKE, Pub, Rep, Req, Router, SIGNATURE, SKIPPED, Socket, Sub,
};
