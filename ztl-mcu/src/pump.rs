//! A node on a serial port: bytes from and to anything that speaks `embedded-io`, or, with the
//! feature `async`, `embedded-io-async`.

#[cfg(feature = "embedded-io-06")]
mod io06;
#[cfg(feature = "async")]
mod plugged;
#[cfg(feature = "async")]
mod run;
mod turn;

#[cfg(feature = "embedded-io-06")]
pub use io06::{Error06, Io06};
#[cfg(feature = "async")]
pub use plugged::Plugged;
pub use turn::{Pump, PumpError};

#[cfg(test)]
mod tests;
