//! Hostile pickles: each is an error that says why, or plain data; no panic, no overflow of the stack, and memory within
//! its bound. One test, so that nothing else allocates meanwhile.

mod corpus;

use corpus::{Case, bombs, cases};
use peak_alloc::PeakAlloc;
use ztl_pickle::{Limits, Pickle};

#[global_allocator]
static ALLOCATOR: PeakAlloc = PeakAlloc;

/// What is allocated besides the 16 times of the input: the 1 MiB of `Limits`, and buffers of fixed size.
const BESIDES: usize = (1 << 20) + (64 << 10);

/// Reads it, and returns the result with the most memory that reading took.
fn measured(bytes: &[u8], limits: Limits) -> (Result<Pickle, ztl_pickle::Error>, usize) {
    let before = ALLOCATOR.current_usage();
    ALLOCATOR.reset_peak_usage();
    let result = Pickle::read_with(bytes, limits);
    (result, ALLOCATOR.peak_usage().saturating_sub(before))
}

/// Reads it within its memory; what is read can be used in every way.
#[track_caller]
fn read(name: &str, bytes: &[u8], limits: Limits) -> Result<Pickle, ztl_pickle::Error> {
    let (result, peak) = measured(bytes, limits);
    let most = 16 * bytes.len() + BESIDES;
    assert!(peak <= most, "{name}: {peak} bytes for {}", bytes.len());
    if let Ok(pickle) = &result {
        let written = pickle.to_bytes();
        let again = Pickle::read_with(
            &written,
            Limits {
                depth: usize::MAX,
                ..Limits::default()
            },
        );
        match again {
            Ok(again) => assert!(again == *pickle, "{name}: not the same again"),
            // What is written may be denser.
            Err(error) => assert!(error.to_string().contains("limit"), "{name}: {error}"),
        }
        assert!(pickle.value().repr().most(5000).to_string().len() <= 5003);
        assert!(pickle.value().to_json(5000).map_or(0, |json| json.len()) <= 5000);
        assert!(pickle.clone() == *pickle, "{name}");
    }
    result
}

#[track_caller]
fn check(case: &Case) {
    let Case { name, bytes, error } = case;
    let result = read(name, bytes, Limits::default());
    if let Some(error) = error {
        let found = result.map_or_else(|error| error.to_string(), |pickle| format!("{pickle:?}"));
        assert!(found.contains(error.as_str()), "{name}: {found}");
        assert!(
            found.bytes().all(|byte| (b' '..=b'~').contains(&byte)),
            "{found:?}"
        );
    }
}

#[test]
fn no_hostile_pickle_is_run_or_takes_much() {
    // Made once, at the first key.
    Pickle::read(b"}NNs.").unwrap();
    let cases = cases();
    assert!(cases.len() > 250, "{}", cases.len());
    for case in &cases {
        check(case);
        for end in 0..case.bytes.len() {
            let cut = &case.bytes[..end];
            let _ = read(&case.name, cut, Limits::default());
        }
        for at in 0..case.bytes.len() {
            for bit in 0..8 {
                let mut bytes = case.bytes.clone();
                bytes[at] ^= 1 << bit;
                let _ = read(&case.name, &bytes, Limits::default());
            }
        }
    }
    let deep = Limits {
        depth: usize::MAX,
        ..Limits::default()
    };
    for count in [10, 300, 40_000, 100_000] {
        for bomb in bombs(count) {
            check(&bomb);
            let _ = read(&bomb.name, &bomb.bytes, deep);
        }
    }
    // The budget counts, too, not only the input.
    let small = Limits {
        memory: 100_000,
        ..deep
    };
    for bomb in bombs(40_000) {
        let (_, peak) = measured(&bomb.bytes, small);
        assert!(peak <= 100_000 + (64 << 10), "{}: {peak}", bomb.name);
    }
}
