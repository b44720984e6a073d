//! See `ztl_fuzz::ends::session`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::ends::session(bytes));
