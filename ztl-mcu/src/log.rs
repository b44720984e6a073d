//! Sends the firmware's log to the gateway.
//!
//! A `LogQueue` (feature `critical-section`) buffers the log until the node has nothing else to send; a
//! [`Pump`](crate::pump::Pump) reads it. With the feature `defmt`, `defmt_logger!` makes the queue the global
//! logger of `defmt::info!` and the other macros.

#[cfg(feature = "critical-section")]
mod queue;
mod source;

#[cfg(feature = "critical-section")]
pub use queue::LogQueue;
pub use source::LogSource;

/// Makes a [`LogQueue`] the global logger of defmt. Invoke it once in the firmware's own crate, next to
/// `defmt::timestamp!`:
///
/// ```ignore
/// static LOG: ztl_mcu::log::LogQueue<512> = ztl_mcu::log::LogQueue::new();
/// ztl_mcu::defmt_logger!(LOG);
/// ```
///
/// The crate needs `defmt` among its own dependencies. The gateway decodes the log with the firmware's ELF file. As with
/// other defmt loggers, interrupts are masked while a record is encoded, so keep records short if an interrupt must not
/// wait. Flushing does nothing, because a firmware that panics cannot send any more.
#[cfg(feature = "defmt")]
#[macro_export]
macro_rules! defmt_logger {
    ($queue:path) => {
        const _: () = {
            #[::defmt::global_logger]
            struct LinkLogger;

            // SAFETY: `acquire` and `release` enclose a critical section, so records do not interleave, and
            // both keep the nesting order that `critical_section` requires.
            unsafe impl ::defmt::Logger for LinkLogger {
                fn acquire() {
                    // SAFETY: released by `release`, or below if a record is already open.
                    let restore = unsafe { $crate::log::critical_section::acquire() };
                    if let Some(restore) = $queue.begin(restore) {
                        // SAFETY: belongs to the `acquire` above.
                        unsafe { $crate::log::critical_section::release(restore) };
                    }
                }

                unsafe fn flush() {}

                unsafe fn release() {
                    if let Some(restore) = $queue.end() {
                        // SAFETY: belongs to the `acquire` that opened the record.
                        unsafe { $crate::log::critical_section::release(restore) };
                    }
                }

                unsafe fn write(bytes: &[u8]) {
                    $queue.write(bytes);
                }
            }
        };
    };
}

#[cfg(feature = "defmt")]
#[doc(hidden)]
pub use ::critical_section;
