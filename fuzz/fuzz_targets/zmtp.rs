//! See `ztl_fuzz::zmtp`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::zmtp::zmtp(bytes));
