//! ROS 1 (`ztl_ros1`): any bytes as a message, and as XML-RPC.
//!
//! The first byte chooses what is tried. `m`: a type's name up to a NUL, then a message of it. `c`: a call of XML-RPC. `r`: a
//! response.

use peak_alloc::PeakAlloc;
use ztl_ros1::message::Definitions;
use ztl_ros1::xmlrpc::{self, Response};

/// What a value may take besides 128 times its length.
const BESIDES: usize = 64 << 10;

/// Any input. The allocator is that of the program.
pub fn check(bytes: &[u8], allocator: &PeakAlloc) {
    match bytes.split_first() {
        Some((b'm', rest)) => message(rest, allocator),
        Some((b'c', rest)) => call(rest, allocator),
        Some((b'r', rest)) => response(rest, allocator),
        _ => {}
    }
}

/// What it returns. It takes bounded memory.
fn bounded<T>(len: usize, allocator: &PeakAlloc, read: impl FnOnce() -> T) -> T {
    let before = allocator.current_usage();
    allocator.reset_peak_usage();
    let value = read();
    let peak = allocator.peak_usage().saturating_sub(before);
    assert!(peak <= 128 * len + BESIDES, "{peak} bytes for {len}");
    value
}

fn message(bytes: &[u8], allocator: &PeakAlloc) {
    let Some(end) = bytes.iter().position(|byte| *byte == 0) else {
        return;
    };
    let (name, rest) = bytes.split_at(end);
    let rest = &rest[1..];
    let mut definitions = Definitions::carried();
    let ty = match definitions.message(&String::from_utf8_lossy(name)) {
        Ok(ty) => ty,
        Err(error) => return assert!(!error.to_string().is_empty()),
    };
    match bounded(rest.len(), allocator, || ty.decode(rest)) {
        Ok(value) => {
            // Compared as bytes: a NaN is not equal to itself. Compared after a second pass: the first replaces bytes that
            // are not UTF-8.
            let written = ty.encode(&value).expect("a value of its type");
            let again = ty.decode(&written).expect("a message");
            assert_eq!(ty.encode(&again).expect("a value of its type"), written);
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

fn call(bytes: &[u8], allocator: &PeakAlloc) {
    match bounded(bytes.len(), allocator, || xmlrpc::parse_call(bytes)) {
        Ok((method, params)) => {
            let written = xmlrpc::call(&method, &params);
            let (method, params) = xmlrpc::parse_call(written.as_bytes()).expect("a call");
            assert_eq!(xmlrpc::call(&method, &params), written);
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

fn response(bytes: &[u8], allocator: &PeakAlloc) {
    match bounded(bytes.len(), allocator, || xmlrpc::parse_response(bytes)) {
        Ok(Response::Value(value)) => {
            let written = xmlrpc::response(&value);
            let again = xmlrpc::parse_response(written.as_bytes()).expect("a response");
            let Response::Value(again) = again else {
                panic!("a fault: {again:?}");
            };
            assert_eq!(xmlrpc::response(&again), written);
        }
        Ok(Response::Fault(_)) => {}
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}
