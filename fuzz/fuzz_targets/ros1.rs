//! See `ztl_fuzz::ros1::check`.
#![no_main]

use peak_alloc::PeakAlloc;

#[global_allocator]
static ALLOCATOR: PeakAlloc = PeakAlloc;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::ros1::check(bytes, &ALLOCATOR));
