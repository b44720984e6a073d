//! See `ztl_fuzz::bus::bus`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::bus::bus(bytes));
