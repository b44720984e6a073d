//! `docs/protocol.md` against the code: plays its traces, compares its tables, and runs its clients.

mod clients;
mod document;
mod parallel;
mod robot;
mod trace;
