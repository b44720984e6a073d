//! See `ztl_fuzz::client_and_server::check`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::client_and_server::check(bytes));
