//! Real processes on a bad line: clients, `ztl gateway`, `ztl line`, `ztl device`, and what the
//! devices themselves have recorded as the only witness.
//!
//! `ZTL_TASKS` and `ZTL_RESETS` say how many, `ZTL_FILL` how many tasks there were before the resets;
//! `cargo xtask soak` runs the long form.

mod ledger;
mod resets;
mod rig;
mod tasks;
