//! A board, a gateway and a client.

use std::time::{Duration, Instant};

use ztl_tests::lab::{Board, COMPLETED, OriginalClient, PATIENCE, Pin, Server, until};

/// From the client's socket to the board's pins.
pub(crate) struct Rig {
    pub(crate) client: OriginalClient,
    pub(crate) gateway: Server,
    pub(crate) board: Board,
}

/// Steps to a millimetre of the stage.
pub(crate) const STEPS: f32 = 40.0;

/// At its slowest it makes a step in a small part of this.
const STILL: Duration = Duration::from_millis(200);

impl Rig {
    #[track_caller]
    pub(crate) fn start(board: &str) -> Self {
        let board = Board::start(board);
        let device = board.device();
        Self::with(board, &device)
    }

    /// The same with something between board and gateway.
    #[track_caller]
    pub(crate) fn with(board: Board, device: &str) -> Self {
        let elf = format!("desk={}", board.elf.display());
        let gateway = Server::gateway_with(&[device], &["--elf", &elf]);
        Self::at(gateway, board)
    }

    /// The same with firmware that logs nothing.
    #[track_caller]
    pub(crate) fn quiet(board: Board, device: &str) -> Self {
        Self::at(Server::gateway(&[device]), board)
    }

    #[track_caller]
    fn at(gateway: Server, board: Board) -> Self {
        gateway.wait_ready("desk");
        Self {
            client: gateway.original_client(),
            gateway,
            board,
        }
    }

    /// Starts a task of the stage and waits until that has come so many steps far.
    #[track_caller]
    pub(crate) fn start_stage(&mut self, goal: &str, steps: u32) -> i64 {
        let from = self.place();
        let id = self.client.start("desk", "stage", goal);
        until("the stage on its way", PATIENCE, || {
            (self.place().abs_diff(from) >= steps).then_some(())
        });
        id
    }

    /// Where the stage really is.
    #[track_caller]
    pub(crate) fn place(&self) -> u32 {
        self.board.read(Pin::Place)
    }

    /// Waits until the stage rests for much longer than a step takes; returns its position.
    #[track_caller]
    pub(crate) fn wait_rest(&self) -> u32 {
        let mut seen = (self.place(), Instant::now());
        until("the stage at rest", PATIENCE, || {
            let place = self.place();
            if place != seen.0 {
                seen = (place, Instant::now());
            }
            (seen.1.elapsed() > STILL).then_some(place)
        })
    }

    /// The stage stands still already.
    #[track_caller]
    pub(crate) fn assert_rests(&self) {
        let place = self.place();
        assert_eq!(self.wait_rest(), place, "the stage still moves");
    }

    /// The firmware's log as printed by the gateway, once it has this many lines with this text.
    #[track_caller]
    pub(crate) fn wait_logged(&self, text: &str, count: usize) -> Vec<String> {
        until(text, PATIENCE, || {
            let log = self.gateway.process.stderr();
            let lines = log.lines().filter(|line| line.contains(text));
            let lines: Vec<String> = lines.map(str::to_owned).collect();
            (lines.len() >= count).then_some(lines)
        })
    }

    /// It works.
    #[track_caller]
    pub(crate) fn assert_serves(&mut self) {
        let id = self.client.start("desk", "lamp", "on");
        let end = self.client.end(id);
        assert_eq!(end, (COMPLETED, "on"));
        assert_eq!(self.board.read(Pin::Lamp), 1);
    }
}
