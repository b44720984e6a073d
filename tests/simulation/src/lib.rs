//! Checks the promises of the link on the real state machines: explores every sequence of events with few faults,
//! and simulates whole laboratories with many.
#![expect(
    clippy::duplicate_mod,
    reason = "the model is compiled for the real ends and for their mutated copy"
)]

pub mod explore;
pub mod fingerprint;
pub mod fleet_mutants;
pub mod lab;
pub mod merging;
pub mod plan;
pub mod shrink;

/// The model of the real ends.
#[path = "."]
pub mod real {
    /// The two ends of the link.
    pub(crate) mod ends {
        pub(crate) use ztl_fleet as fleet;
        pub(crate) use ztl_link as link;
        pub(crate) use ztl_mcu as mcu;
    }
    pub mod fleet;
    pub mod model;
}

pub mod mutants;

/// The model of a copy of the ends with switchable mutations.
#[path = "."]
pub mod broken {
    use std::cell::Cell;

    /// The copy that `build.rs` makes.
    pub mod ends {
        include!(concat!(env!("OUT_DIR"), "/ends.rs"));
    }
    pub mod fleet;
    pub mod model;

    thread_local! {
        static MUTANT: Cell<Option<usize>> = const { Cell::new(None) };
    }

    /// Switches on one of the [mutants](crate::mutants::MUTANTS), on this thread.
    pub fn switch(mutant: Option<usize>) {
        MUTANT.set(mutant);
    }

    /// Whether any mutant is switched on.
    pub(crate) fn is_on() -> bool {
        MUTANT.get().is_some()
    }

    /// Whether one of these mutants is switched on.
    pub(crate) fn is(mutants: &[usize]) -> bool {
        MUTANT.get().is_some_and(|on| mutants.contains(&on))
    }

    /// Names of the mutants whose code is not found.
    #[must_use]
    pub fn lost() -> Vec<&'static str> {
        let all = || {
            crate::mutants::MUTANTS
                .iter()
                .chain(crate::fleet_mutants::FLEET)
        };
        let name = |number: &usize| all().nth(*number).map(|mutant| mutant.name);
        ends::LOST.iter().filter_map(name).collect()
    }
}
