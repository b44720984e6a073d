//! See `ztl_fuzz::link::stream`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::link::stream(bytes));
