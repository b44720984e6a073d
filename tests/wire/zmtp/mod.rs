//! A device that serves ZeroMQ itself (`examples/zmtp.rs`): old and new clients, several implementations, and invalid streams.

mod clients;
mod device;
mod invalid_clients;
mod many_clients;
