//! Fleets: robots of many rooms and buildings behind one ZTL endpoint, over Eclipse Zenoh. A beginning: nothing can be run yet.
//!
//! [`agent`] and [`endpoint`] are the rules, without I/O and without Zenoh; [`wire`] is what they say to each other
//! (docs/fleet.md).

pub mod agent;
pub mod endpoint;
pub mod wire;
