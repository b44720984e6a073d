//! A node on a serial port: bytes from and to anything that speaks `embedded-io`, or, with the
//! feature `async`, `embedded-io-async`.

#[cfg(feature = "async")]
mod run;
mod turn;

pub use turn::{Pump, PumpError};

#[cfg(test)]
mod tests;
