//! `docs/protocol.md` against the code: its traces are played, its tables compared, and the clients it
//! points to are run.

mod clients;
mod document;
mod parallel;
mod robot;
mod trace;
