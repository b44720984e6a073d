//! Fleets: robots of many rooms and buildings behind one ZTL endpoint, over Eclipse Zenoh.
//!
//! [`agent`] and [`endpoint`] are the rules, without I/O and without Zenoh; [`wire`] is what they say to each other, and
//! [`seal`] how they know each other (docs/fleet.md).

pub mod agent;
pub mod caller;
pub mod config;
pub mod endpoint;
pub mod join;
pub mod journal;
pub mod random;
pub mod seal;
pub mod seldom;
pub mod serve;
pub mod session;
pub mod wire;
