#![no_std]
#![no_main]
use ztl_proof as _;
#[panic_handler]
fn on_panic(_: &core::panic::PanicInfo<'_>) -> ! { loop {} }
#[unsafe(no_mangle)]
extern "C" fn main() -> ! { loop {} }
