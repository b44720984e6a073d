//! What crosses crates. The documentation tests of this package are the README's examples.

pub mod lab;
