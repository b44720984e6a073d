//! The firmware's log on its way to the gateway.
//!
//! A `LogQueue` (feature `critical-section`) keeps it until the node has nothing else to send; a
//! [`Pump`](crate::pump::Pump) is told where it is. With the feature `defmt`, `defmt_logger!` makes it
//! the place that `defmt::info!` and the others write to.

#[cfg(feature = "critical-section")]
mod queue;

#[cfg(feature = "critical-section")]
pub use queue::LogQueue;

/// Where a node finds the log that it sends when it has nothing else to send.
///
/// The log is a stream of bytes; a node cuts it anywhere, and some of it may be lost on the line.
pub trait LogSource {
    /// Takes the next bytes into `buffer` and says how many.
    fn read(&self, buffer: &mut [u8]) -> usize;

    /// How many bytes were dropped since the boot because there was no room; wraps.
    fn lost(&self) -> u32;
}

/// No log.
impl LogSource for () {
    fn read(&self, _buffer: &mut [u8]) -> usize {
        0
    }

    fn lost(&self) -> u32 {
        0
    }
}

/// Makes a [`LogQueue`] the place that defmt writes to. For firmware's own crate, once, beside
/// `defmt::timestamp!`:
///
/// ```ignore
/// static LOG: ztl_mcu::log::LogQueue<512> = ztl_mcu::log::LogQueue::new();
/// ztl_mcu::defmt_logger!(LOG);
/// ```
///
/// The crate needs `defmt` among its own dependencies. The gateway reads the log with the firmware's
/// ELF file. While a record is made interrupts are held off, as with other loggers of defmt: for as long as its values
/// take to be encoded, so keep records short where an interrupt must not wait. Flushing does nothing: a firmware that panics cannot send any more.
#[cfg(feature = "defmt")]
#[macro_export]
macro_rules! defmt_logger {
    ($queue:path) => {
        const _: () = {
            #[::defmt::global_logger]
            struct LinkLogger;

            // SAFETY: between `acquire` and `release` there is a critical section, so records do not
            // mix; both keep the order that `critical_section` asks for.
            unsafe impl ::defmt::Logger for LinkLogger {
                fn acquire() {
                    // SAFETY: released by `release`, or below when a record is being made already.
                    let restore = unsafe { $crate::log::critical_section::acquire() };
                    if let Some(restore) = $queue.begin(restore) {
                        // SAFETY: of the `acquire` above.
                        unsafe { $crate::log::critical_section::release(restore) };
                    }
                }

                unsafe fn flush() {}

                unsafe fn release() {
                    if let Some(restore) = $queue.end() {
                        // SAFETY: of the `acquire` that began the record.
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
