//! The interrupts' part of a Cortex-M's vector table.

/// Defines the table for this many interrupts, some of which have a handler: `vectors! { 6: 5 => on_uart }`. Higher
/// interrupts are never enabled.
#[macro_export]
macro_rules! vectors {
    ($count:literal: $($number:literal => $handler:path),+) => {
        #[used]
        #[unsafe(no_mangle)]
        #[unsafe(link_section = ".vector_table.interrupts")]
        static __INTERRUPTS: [extern "C" fn(); $count] = {
            let mut vectors: [extern "C" fn(); $count] = [$crate::unexpected; $count];
            $({
                let (_, [vector, ..]) = vectors.split_at_mut($number) else { panic!() };
                *vector = $handler;
            })+
            vectors
        };
    };
}

/// Handles an interrupt that was not enabled.
pub extern "C" fn unexpected() {
    cortex_m::peripheral::SCB::sys_reset()
}
