//! Pickles (`ztl_pickle`): any bytes, with limits that nested values and keys reach.

use peak_alloc::PeakAlloc;
use ztl_pickle::{Limits, Pickle};

/// What a pickle may take besides 16 times its length: the 1 MiB of `Limits`, and small buffers.
const BESIDES: usize = (1 << 20) + (64 << 10);

/// Any input. The allocator is that of the program.
pub fn check(bytes: &[u8], allocator: &PeakAlloc) {
    let limits = Limits {
        depth: 1 << 20,
        ..Limits::default()
    };
    let before = allocator.current_usage();
    allocator.reset_peak_usage();
    let result = Pickle::read_with(bytes, limits);
    let peak = allocator.peak_usage().saturating_sub(before);
    assert!(peak <= 16 * bytes.len() + BESIDES, "{peak} bytes");
    let pickle = match result {
        Ok(pickle) => pickle,
        Err(error) => {
            assert!(
                error
                    .to_string()
                    .bytes()
                    .all(|byte| (b' '..=b'~').contains(&byte))
            );
            return;
        }
    };
    assert!(pickle.value().repr().most(1000).to_string().len() <= 1003);
    assert!(pickle.value().to_json(1000).map_or(0, |json| json.len()) <= 1000);
    let written = pickle.to_bytes();
    let again = Pickle::read_with(&written, limits).expect("what is written can be read");
    assert!(again == pickle, "not the same again");
    assert!(again.to_bytes() == written, "not the same bytes again");
}
