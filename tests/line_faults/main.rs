//! Real processes on a bad line: clients, `ztl gateway`, `ztl line`, `ztl device`, and what the
//! devices themselves have recorded as the only witness.
//!
//! `ZTL_TASKS` and `ZTL_RESETS` say how many, `ZTL_FILL` how many tasks there were before the resets;
//! `cargo xtask soak` runs the long form.

#![cfg(target_os = "linux")]

mod books;
mod resets;
mod rig;
mod tasks;

/// How many, unless the environment says otherwise.
fn count(variable: &str, default: usize) -> usize {
    std::env::var(variable).map_or(default, |text| {
        let number = text.parse();
        number.unwrap_or_else(|_| panic!("{variable} is a number, not '{text}'"))
    })
}
