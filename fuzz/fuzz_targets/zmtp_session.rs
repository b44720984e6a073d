//! See `ztl_fuzz::zmtp_session`.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| ztl_fuzz::zmtp_session::zmtp_session(bytes));
