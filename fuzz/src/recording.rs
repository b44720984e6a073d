//! Recordings (`ztl_record`): any bytes as a file.

use std::io::Cursor;

use peak_alloc::PeakAlloc;
use ztl_record::Reader;

/// What reading may take: so many times the input, and this many bytes more. A pickle takes up to 16 times its length
/// and 1 MiB; blocks of 256 KiB are read.
const TIMES: usize = 32;
const BESIDES: usize = 3 << 20;

/// Any input. The allocator is that of the program.
pub fn check(bytes: &[u8], allocator: &PeakAlloc) {
    let before = allocator.current_usage();
    allocator.reset_peak_usage();
    let mut reader = Reader::new(Cursor::new(bytes.to_vec()));
    let mut messages = 0;
    for read in reader.by_ref() {
        messages += 1;
        let _ = read.body();
    }
    let peak = allocator.peak_usage().saturating_sub(before);
    assert!(peak <= TIMES * bytes.len() + BESIDES, "{peak} bytes");
    // Each takes its header at least.
    assert!(messages <= bytes.len() / 31);
    let wrong = reader.damage().to_string();
    assert!(!wrong.chars().any(char::is_control), "{wrong:?}");
    assert_eq!(wrong.is_empty(), !reader.damage().is_any());
}
