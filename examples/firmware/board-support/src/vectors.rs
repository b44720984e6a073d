//! The interrupts' part of a Cortex-M's vector table.

/// Lays down a table of so many interrupts, of which some have a function: `vectors! { 6: 5 => on_uart }`.
/// Those above are never allowed to come.
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

/// An interrupt that nobody has allowed.
pub extern "C" fn unexpected() {
    cortex_m::peripheral::SCB::sys_reset()
}
