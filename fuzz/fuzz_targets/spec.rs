//! See `ztl_fuzz::spec::check`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::spec::check(bytes));
