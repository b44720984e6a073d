//! See `ztl_fuzz::seal::check`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::seal::check(bytes));
