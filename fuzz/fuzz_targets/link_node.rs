//! See `ztl_fuzz::link_ends::node`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::link_ends::node(bytes));
