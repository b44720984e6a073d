//! Says where libzmq and libsodium lie, a directory a line; all else is in `build.rs`.

fn main() {
    println!("{}\n{}", env!("ZTL_ZMQ"), env!("ZTL_SODIUM"));
}
