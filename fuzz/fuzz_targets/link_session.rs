//! See `ztl_fuzz::link_ends::session`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::link_ends::session(bytes));
