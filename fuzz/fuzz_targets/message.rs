//! See `ztl_fuzz::message::check`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::message::check(bytes));
