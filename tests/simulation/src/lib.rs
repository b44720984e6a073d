//! The promises of the link, checked over the real state machines: by exploring all that can happen
//! with few faults, and by simulating whole laboratories with many.
#![expect(
    clippy::duplicate_mod,
    reason = "the model is compiled for the ends as they are, and for those that can be broken"
)]

pub mod explore;
pub mod fingerprint;
pub mod lab;
pub mod plan;
pub mod shrink;

/// The model over the ends as they are.
#[path = "."]
pub mod real {
    /// The two ends of the link.
    pub(crate) mod ends {
        pub(crate) use ztl_link as session;
        pub(crate) use ztl_mcu as mcu;
    }
    pub mod model;
}

pub mod mutants;

/// The model over a copy of the ends that can be broken.
#[path = "."]
pub mod broken {
    use std::cell::Cell;

    /// The copy, made by `build.rs`.
    pub mod ends {
        include!(concat!(env!("OUT_DIR"), "/ends.rs"));
    }
    pub mod model;

    thread_local! {
        static MISTAKE: Cell<Option<usize>> = const { Cell::new(None) };
    }

    /// Switches one of the [mistakes](crate::mutants::MUTANTS) on, on this thread.
    pub fn switch(mistake: Option<usize>) {
        MISTAKE.set(mistake);
    }

    /// Whether one of these is switched on.
    pub(crate) fn is(mistakes: &[usize]) -> bool {
        MISTAKE.get().is_some_and(|on| mistakes.contains(&on))
    }

    /// Mistakes whose place in the source is not found, by name.
    #[must_use]
    pub fn lost() -> Vec<&'static str> {
        let name = |number: &usize| crate::mutants::MUTANTS[*number].name;
        ends::LOST.iter().map(name).collect()
    }
}
