//! See `ztl_fuzz::sse::check`.
#![no_main]

use peak_alloc::PeakAlloc;

#[global_allocator]
static ALLOCATOR: PeakAlloc = PeakAlloc;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::sse::check(bytes, &ALLOCATOR));
