//! See `ztl_fuzz::goal::check`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::goal::check(bytes));
