//! Nothing: what is built here is C++, by `build.rs`, which says where it lies.

#![no_std]
