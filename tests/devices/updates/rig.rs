//! A board with the bootloader and two images.

use std::collections::BTreeSet;
use std::process::Command;
use std::time::{Duration, Instant};

use ztl_core::link::update::{UpdateCommand, UpdateError, UpdatePhase};
use ztl_tests::lab::{DebuggedBoard, FlashImage, PATIENCE, Process, Scratch, microbit, until, ztl};

use super::talk::{Said, Talk};

/// Where the active partition begins, as `partitions.x` says.
pub(crate) const ACTIVE: usize = 0x2400;
/// The partitions: state, active, and for what is received.
pub(crate) const PARTITIONS: std::ops::Range<usize> = 0x2000..0x22000;
/// Length of a page.
pub(crate) const PAGE: usize = 1024;
/// So many bytes tell a function.
const CODE: usize = 8;
/// Longer pieces of an image do not fit the board's queue.
const PIECE: usize = 96;

/// How long a script may take from one change of the flash to the next that it stops at. QEMU runs code slowly that is in the
/// same page as a stop: it may be that of the verification.
const LIMIT: Duration = PATIENCE.saturating_mul(5);
/// How long a node verifies before it is asked again. It verifies nothing while it sends an answer, and where QEMU is slow, one
/// answer after the other would leave it no time.
const VERIFY: Duration = Duration::from_millis(50);
/// An update and a way back make about 35,000 changes.
const MOST_CHANGES: usize = 50_000;

/// The versions of the two images.
pub(crate) const OLD: &str = "1.0.0";
pub(crate) const NEW: &str = "1.1.0";

/// A change of the flash.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Change {
    pub(crate) is_erase: bool,
    pub(crate) address: usize,
}

/// What is done with the node over its link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Script {
    /// Until it says its version.
    Greet,
    /// Sends the image, has it verified and started, until the node says its version after the restart.
    Update,
    /// Confirms what runs.
    Confirm,
}

/// How a script has ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum End {
    Version(String),
    Confirmed,
    Failed(UpdateError),
    /// At a change of the flash.
    Stopped,
}

pub(crate) struct Rig {
    pub(crate) board: DebuggedBoard,
    /// The functions that erase a page, and those that write a word, of all images: where they are, and how they begin.
    erases: Vec<(u64, Vec<u8>)>,
    writes: Vec<(u64, Vec<u8>)>,
    stops_at_writes: bool,
    /// The bytes of the old and the new image.
    pub(crate) images: [Vec<u8>; 2],
    /// Where the stack may be, for all images.
    stack: std::ops::Range<usize>,
    /// The file for the update to the new one.
    pub(crate) file: Vec<u8>,
    /// The flash as it is in the beginning.
    pub(crate) first: Vec<u8>,
    /// Where the update went on, in bytes; set to `None` before.
    pub(crate) resumed: Option<u32>,
    talk: Talk,
}

/// Signs an image with the example's key.
#[track_caller]
pub(crate) fn signed(image: &[u8], version: &str, board: &str) -> Vec<u8> {
    let scratch = Scratch::new();
    let (path, file) = (scratch.path("image.bin"), scratch.path("image.ztl"));
    std::fs::write(&path, image).expect("a file");
    let mut sign = Command::new("sh");
    let ztl = ztl();
    sign.args(["-c", "out=$1; shift; exec \"$@\" > \"$out\"", "sh"])
        .arg(&file);
    sign.arg(ztl.get_program())
        .args(ztl.get_args())
        .args(["firmware", "sign"])
        .arg(&path);
    sign.arg("-k")
        .arg(microbit().join("example.firmware_secret"));
    let ended = Process::run(sign.args(["--board", board, "--version", version]));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    std::fs::read(&file).expect("a signed image")
}

impl Rig {
    /// The board, with the old image in its flash, halted.
    #[track_caller]
    pub(crate) fn start() -> Self {
        let [boot, old, new] = ["boot", "update", "updated"]
            .map(|name| FlashImage::built(&format!("microbit-{name}")));
        let mut first = vec![0xFF; PARTITIONS.end];
        for image in [&boot, &old] {
            let (at, bytes) = image.bytes();
            first[at..at + bytes.len()].copy_from_slice(&bytes);
        }
        let of = |name: &str| {
            let images = [&boot, &old, &new];
            let function = images.map(|image| {
                let (address, (at, bytes)) = (image.symbol(name), image.bytes());
                let begin = address as usize - at;
                (address, bytes[begin..begin + CODE].to_vec())
            });
            function.to_vec()
        };
        let begin = [&boot, &old, &new].map(|image| image.symbol("__sheap"));
        let begin = begin.into_iter().max().expect("images");
        let stack = begin as usize..old.symbol("_stack_start") as usize;
        let images = [&old, &new].map(|image| image.bytes().1);
        let mut rig = Self {
            board: DebuggedBoard::start(),
            erases: of("flash_erase_page"),
            writes: of("flash_write_word"),
            stops_at_writes: false,
            file: signed(&images[1], NEW, "microbit"),
            images,
            first,
            stack,
            resumed: None,
            talk: Talk::new(),
        };
        rig.board.write_flash(0, &rig.first);
        rig.board.cut_power();
        rig
    }

    /// Puts these partitions into the flash, and switches the board off and on; it is halted.
    #[track_caller]
    pub(crate) fn restore(&mut self, partitions: &[u8]) {
        self.board.halt();
        self.board.write_flash(PARTITIONS.start, partitions);
        self.board.cut_power();
    }

    /// Stops at each erase, or each change of the flash; or at none any more.
    #[track_caller]
    pub(crate) fn set_stops(&mut self, erases: bool, writes: bool) {
        let mut stops = BTreeSet::new();
        stops.extend(self.erases.iter().filter(|_| erases).map(|at| at.0));
        stops.extend(self.writes.iter().filter(|_| writes).map(|at| at.0));
        self.board.set_stops(&stops);
        self.stops_at_writes = writes;
    }

    /// Runs the halted board with a script. At each change of the flash that it stops at, `at_change` says whether to go on.
    /// Then it is halted.
    #[track_caller]
    pub(crate) fn run(
        &mut self,
        script: Script,
        mut at_change: impl FnMut(&mut DebuggedBoard, Change) -> bool,
    ) -> End {
        let mut last_progress = Instant::now();
        let mut changes = 0;
        let mut is_restarted = false;
        let mut last = None;
        self.talk.greet(&mut self.board.serial);
        self.board.run();
        loop {
            assert!(
                last_progress.elapsed() < LIMIT,
                "{script:?} makes no progress: {:?}",
                self.talk
            );
            if self.board.wait(20) {
                let (at, [address, _]) = self.board.stopped_at();
                let here = (at, self.board.read_memory(at as usize..at as usize + CODE));
                let change = Change {
                    is_erase: self.erases.contains(&here),
                    address: address as usize,
                };
                // The other image has its functions elsewhere.
                let is_write = self.stops_at_writes && self.writes.contains(&here);
                // QEMU sometimes stops twice for one change. No firmware repeats one without another in between.
                let again = last.replace(change) == Some(change);
                if again || !change.is_erase && !is_write {
                    self.board.run();
                    continue;
                }
                if !at_change(&mut self.board, change) {
                    return End::Stopped;
                }
                last_progress = Instant::now();
                changes += 1;
                assert!(changes < MOST_CHANGES, "{script:?} has no end");
                self.board.run();
                continue;
            }
            let Some(said) = self.talk.hear(&mut self.board.serial) else {
                self.talk.retry(&mut self.board.serial);
                continue;
            };
            if matches!(said, Said::Phase(UpdatePhase::Verifying)) {
                std::thread::sleep(VERIFY);
            }
            if let Some(end) = self.answer(script, said, &mut is_restarted) {
                self.board.halt();
                return end;
            }
        }
    }

    /// Goes on with an update that was stopped, until the node has said so many times that it verifies. The board runs one turn
    /// of its main loop after the other; each calls the function at this address.
    #[track_caller]
    pub(crate) fn verify_by_turns(&mut self, turn: u64, times: usize) {
        self.board.set_stops(&BTreeSet::from([turn]));
        let mut answers = 0;
        while answers < times {
            self.board.run();
            until("a turn", PATIENCE, || self.board.wait(20).then_some(()));
            let Some(said) = self.talk.hear(&mut self.board.serial) else {
                self.talk.retry(&mut self.board.serial);
                continue;
            };
            match said {
                Said::Phase(UpdatePhase::Verifying) => answers += 1,
                said if answers > 0 => panic!("after {answers} answers {said:?}"),
                _ => {}
            }
            let end = self.answer(Script::Update, said, &mut false);
            assert_eq!(end, None);
        }
    }

    /// Answers the node, or gives the end of the script.
    fn answer(&mut self, script: Script, said: Said, is_restarted: &mut bool) -> Option<End> {
        let line = &mut self.board.serial;
        let (manifest, image) = self.file.split_at(ztl_core::manifest::MANIFEST_LEN);
        let command = match said {
            Said::Awake => {
                self.talk.greet(line);
                return None;
            }
            Said::Welcome(version) => match script {
                Script::Update if !*is_restarted => UpdateCommand::Begin {
                    now: false,
                    downgrade: false,
                    manifest,
                },
                Script::Confirm => UpdateCommand::Confirm,
                _ => return Some(End::Version(version)),
            },
            Said::Phase(phase) => match phase {
                UpdatePhase::Idle if script == Script::Confirm => UpdateCommand::Read,
                UpdatePhase::Stopping => UpdateCommand::Begin {
                    now: false,
                    downgrade: false,
                    manifest,
                },
                UpdatePhase::Receiving { offset } => {
                    let at = offset as usize;
                    if at == image.len() {
                        UpdateCommand::Finish
                    } else {
                        let bytes = &image[at..image.len().min(at + PIECE)];
                        self.resumed.get_or_insert(offset);
                        UpdateCommand::Write { offset, bytes }
                    }
                }
                UpdatePhase::Verifying => UpdateCommand::Ask,
                UpdatePhase::Ready => {
                    *is_restarted = true;
                    UpdateCommand::Restart
                }
                // It says that it is awake.
                UpdatePhase::Restarting => return None,
                UpdatePhase::Failed(error) => return Some(End::Failed(error)),
                UpdatePhase::Idle => panic!("the update was given up"),
            },
            Said::Firmware(confirmed) => {
                assert!(confirmed);
                return Some(End::Confirmed);
            }
            Said::Refused(reason) => panic!("refused: {reason}"),
        };
        self.talk.command(line, command);
        None
    }

    /// The version of the image that is in the active partition, whole.
    #[track_caller]
    pub(crate) fn active(&mut self) -> Option<&'static str> {
        let longest = self.images.iter().map(Vec::len).max().unwrap_or_default();
        let active = self.board.read_memory(ACTIVE..ACTIVE + longest);
        let mut known = self.images.iter().zip([OLD, NEW]);
        let found = known.find(|(image, _)| active.starts_with(image));
        found.map(|(_, version)| version)
    }

    /// Bytes of RAM that the stack has never reached. In QEMU they are zeros in the beginning.
    #[track_caller]
    pub(crate) fn stack_left(&mut self) -> usize {
        let ram = self.board.read_memory(self.stack.clone());
        ram.iter().take_while(|byte| **byte == 0).count()
    }

    /// Runs the halted board without stops, until it serves. The version that it says is the image that it has.
    #[track_caller]
    pub(crate) fn assert_serves(&mut self, context: &str) -> &'static str {
        self.set_stops(false, false);
        let end = self.run(Script::Greet, |_, change| panic!("stops at {change:?}"));
        let active = self.active();
        let active =
            active.unwrap_or_else(|| panic!("{context}: a mixture of images, which says {end:?}"));
        assert_eq!(end, End::Version(active.to_owned()), "{context}");
        active
    }
}
