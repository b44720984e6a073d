//! A device that is a server by itself (`examples/zmtp.rs`), as ZeroMQ clients see it: old ones and new, of several
//! kinds, and streams that are no client at all.

mod clients;
mod crowds;
mod device;
mod strangers;
