//! See `ztl_fuzz::stream_head::check`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::stream_head::check(bytes));
