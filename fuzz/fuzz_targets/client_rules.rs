//! See `ztl_fuzz::client_rules::check`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::client_rules::check(bytes));
