//! Fleets: robots of many rooms and buildings behind one ZTL endpoint, over Eclipse Zenoh.
//!
//! [`agent`] and [`endpoint`] are the rules, without I/O and without Zenoh; [`wire`] is what they say to each other, and
//! `seal` how they know each other (docs/fleet.md). It needs the feature of its name, and the rest `processes`.

pub mod agent;
#[cfg(feature = "processes")]
pub mod caller;
#[cfg(feature = "processes")]
pub mod config;
pub mod endpoint;
#[cfg(feature = "processes")]
pub mod join;
#[cfg(feature = "processes")]
pub mod journal;
#[cfg(feature = "processes")]
mod lives;
#[cfg(feature = "processes")]
mod obstacles;
#[cfg(feature = "processes")]
pub mod random;
#[cfg(feature = "processes")]
pub mod routers;
#[cfg(feature = "seal")]
pub mod seal;
#[cfg(feature = "processes")]
pub mod seldom;
#[cfg(feature = "processes")]
pub mod serve;
#[cfg(feature = "processes")]
pub mod session;
pub mod streams;
#[cfg(feature = "processes")]
mod tls;
pub mod wire;
