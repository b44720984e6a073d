//! The desk robot on an ST Nucleo-F401RE as an RTIC app: the serial port works by DMA in both directions, and the robot
//! runs in `idle`. Pins and line are those of `nucleo-f401re`.
//!
//! A circular DMA receives. Its interrupts at the half and the end of its memory, and the UART's when the line falls idle,
//! pass on what has arrived, so an interrupt comes at most once per frame and 32 bytes, at any baud rate. Another DMA sends
//! from the frame buffer of the node.
#![no_std]
#![no_main]

#[path = "../../board.rs"]
mod board;
mod chip;
mod dma;
#[path = "../../pins.rs"]
mod pins;

use core::panic::PanicInfo;

use cortex_m::peripheral::SCB;

#[rtic::app(device = crate::chip, peripherals = false)]
mod robot {
    use board_support::boots;
    use board_support::clock::SysTick;

    use crate::board::{self, Board};
    use crate::dma::{Receiver, Sender};

    #[shared]
    struct Shared {
        /// Of tasks with one priority.
        #[lock_free]
        receiver: Receiver,
    }

    #[local]
    struct Local {
        board: Board<Sender>,
    }

    #[init]
    fn init(context: init::Context) -> (Shared, Local) {
        crate::pins::start();
        let (receiver, port) = crate::dma::start();
        let clock = SysTick::start(context.core.SYST);
        let board = Board { port, clock };
        (Shared { receiver }, Local { board })
    }

    #[idle(local = [board])]
    fn idle(context: idle::Context) -> ! {
        app::run(boots::count(), board::pins(), context.local.board)
    }

    #[task(binds = DMA1_STREAM5, priority = 2, shared = [receiver])]
    fn half_or_end(context: half_or_end::Context) {
        context.shared.receiver.on_dma();
    }

    #[task(binds = USART2, priority = 2, shared = [receiver])]
    fn line_idle(context: line_idle::Context) {
        context.shared.receiver.on_idle();
    }

    /// Each millisecond.
    #[task(binds = SysTick, priority = 1)]
    fn tick(_: tick::Context) {
        board::tick();
    }
}

/// Resets the board, so that the gateway can report the tasks that were running.
#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
