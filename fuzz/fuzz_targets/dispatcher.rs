//! See `ztl_fuzz::dispatcher::check`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::dispatcher::check(bytes));
