//! See `ztl_fuzz::manifest::check`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::manifest::check(bytes));
