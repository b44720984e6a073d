//! Real processes on a bad line: clients, `ztl gateway`, `ztl line`, `ztl device`, and what the
//! devices' own records as the only witness.
//!
//! `ZTL_TASKS` and `ZTL_RESETS` set the numbers, `ZTL_FILL` the number of tasks before the resets;
//! `cargo xtask soak` runs the long form.

mod ledger;
mod resets;
mod rig;
mod tasks;
