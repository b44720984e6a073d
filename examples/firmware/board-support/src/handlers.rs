//! The handlers that every Cortex-M board needs.

/// Defines the handler of SysTick, which advances the clock and then calls a function, if one is given; and that of
/// panics, which resets the board, so that the gateway can report the tasks that were running.
#[macro_export]
macro_rules! handlers {
    ($($at_tick:path)?) => {
        #[cortex_m_rt::exception]
        fn SysTick() {
            $crate::clock::tick();
            $($at_tick();)?
        }

        #[panic_handler]
        fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
            cortex_m::peripheral::SCB::sys_reset()
        }
    };
}
