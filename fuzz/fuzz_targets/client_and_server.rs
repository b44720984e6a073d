//! See `ztl_fuzz::conversation::check`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::conversation::check(bytes));
