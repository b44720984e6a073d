//! `cargo xtask firmware` and `cargo xtask qemu`: the images of `examples/firmware`, one a board.

use std::fs;
use std::path::PathBuf;

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};
use crate::cross::Core;
use crate::cycles::{self, Count};
use crate::image::{self, Image};
use crate::tools;

/// The packages of the boards, which are no members of the workspace.
pub(crate) const MANIFEST: &str = "examples/firmware/Cargo.toml";

/// Which boards there are.
const BOARDS: &str = "examples/firmware/boards.txt";

/// Below the target directory: where the images are built, each in its target's directory.
const BUILT: &str = "firmware";

/// The board whose images are weighed and counted.
const WEIGHED: &str = "microbit";

/// An image with a network stack, which it is the only one to have.
const NETWORKED: &str = "ethernet";
/// What it needs.
const NETWORK: &str = "--features ethernet";

/// Boards that have further images, which log nothing: the robot, the smallest node of use, a bare
/// serial port, and servers for ZeroMQ clients without a gateway.
const MORE: &[(&str, &[&str])] = &[
    (WEIGHED, &["quiet", "smallest", "uart", "zmtp"]),
    ("lm3s6965evb", &["zmtp", NETWORKED]),
    ("mps2-an386", &["uart", "zmtp"]),
];

/// What takes the log out of an image.
const QUIET: &str = "--no-default-features";

/// Says what the images take.
const README: &str = "examples/firmware/README.md";

/// A line of [`BOARDS`].
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Board {
    pub(crate) name: String,
    pub(crate) target: String,
    /// The command that runs it in QEMU, without the image; `None` where nothing does.
    pub(crate) machine: Option<String>,
}

/// Builds one board's image, or all.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    let boards = match args {
        [] => boards()?,
        [name] => vec![board(name)?],
        _ => return Err("`cargo xtask firmware` takes a board's name, or nothing for all".into()),
    };
    for board in boards {
        for path in build(dirs, &board)? {
            let Image { flash, ram, .. } = Image::read(&path)?;
            println!(
                "{}: {flash} bytes of flash, {ram} of static RAM",
                path.display()
            );
        }
    }
    Ok(())
}

/// Builds one board's image and runs it in QEMU, until that is ended.
pub(crate) fn run_in_qemu(dirs: &Dirs, args: &[String]) -> Outcome {
    let usage = || "`cargo xtask qemu` takes a board's name and perhaps a port: microbit 5555";
    let (name, port) = match args {
        [name] => (name, 5555),
        [name, port] => (name, port.parse::<u16>().map_err(|_| usage())?),
        _ => return Err(usage().into()),
    };
    let board = board(name)?;
    let Some(machine) = &board.machine else {
        return Err(format!(
            "QEMU has no {name}; its README says how to flash one"
        ));
    };
    tools::provide_qemu()?;
    let images = build(dirs, &board)?;
    let image = images.first().ok_or("the board has no image")?;
    println!(
        "\n{name} runs, with its serial port at TCP port {port}. In another terminal:\n\n    \
         cargo run --bin ztl -- gateway -d desk=tcp:127.0.0.1:{port} -p 12345 -s /lab --elf desk={elf}\n    \
         cargo run --bin ztl -- task-client -r localhost -p 12345 -s /lab desk:stage:home\n\n\
         Ctrl-A X ends QEMU.",
        elf = image.display()
    );
    Cmd::new(machine)
        .args("-nographic -monitor none -serial")
        .arg(format!(
            "tcp:127.0.0.1:{port},server=on,wait=off,nodelay=on"
        ))
        .arg("-kernel")
        .arg(image)
        .run()
}

/// Whether an image has much code that is not ours: a network stack, which may panic and formats text.
pub(crate) fn has_foreign_code(image: &str) -> bool {
    image.ends_with(NETWORKED)
}

/// Lints and builds all of them.
pub(crate) fn check(dirs: &Dirs) -> Outcome {
    for board in boards()? {
        let core = Core::provide(&board.target)?;
        // Debian's compiler is not the one that clippy belongs to.
        if let Core::Compiled(_) = core {
            for features in ["", NETWORK] {
                if features.is_empty() || images(&board).contains(&NETWORKED) {
                    let clippy = cargo(dirs, &core, "clippy", &board).args(features);
                    clippy.args("-- -D warnings").run()?;
                }
            }
        }
        build(dirs, &board)?;
    }
    bench(dirs)
}

/// Builds all that the tests run.
pub(crate) fn build_for_qemu(dirs: &Dirs) -> Outcome {
    for board in boards()?.iter().filter(|board| board.machine.is_some()) {
        build(dirs, board)?;
    }
    Ok(())
}

/// Builds a board's images: the paths of their ELF files, the robot's first.
pub(crate) fn build(dirs: &Dirs, board: &Board) -> Outcome<Vec<PathBuf>> {
    image::check_lock(MANIFEST)?;
    let mut paths = vec![build_image(dirs, board, &board.name, "")?];
    for image in images(board) {
        let mut features = QUIET.to_owned();
        if *image == NETWORKED {
            features = format!("{QUIET} {NETWORK}");
        }
        let image = format!("{}-{image}", board.name);
        paths.push(build_image(dirs, board, &image, &features)?);
    }
    Ok(paths)
}

/// A board's further images.
fn images(board: &Board) -> &'static [&'static str] {
    let more = MORE.iter().find(|(name, _)| *name == board.name);
    more.map_or(&[], |(_, images)| images)
}

fn build_image(dirs: &Dirs, board: &Board, image: &str, features: &str) -> Outcome<PathBuf> {
    let core = Core::provide(&board.target)?;
    let build = cargo(dirs, &core, "build", board);
    let build = build.arg("--bin").arg(image).args(features);
    core.with_linker(dirs, build)?.run()?;
    let built = dirs.target.join(BUILT).join(&board.target).join("release");
    Ok(built.join(image))
}

/// What a Cortex-M0 takes for a byte and for a task: counted, against what the README says.
pub(crate) fn bench(dirs: &Dirs) -> Outcome {
    tools::provide_qemu()?;
    image::check_lock(MANIFEST)?;
    let image = build_image(dirs, &board(WEIGHED)?, &format!("{WEIGHED}-bench"), QUIET)?;
    let counts = cycles::count(dirs, &image)?;
    println!("\nA Cortex-M0, optimised for size:\n\n{}\n", table(&counts));
    println!("{}", rate(&counts)?);
    let readme =
        fs::read_to_string(README).map_err(|error| format!("cannot read {README}: {error}"))?;
    check_counts(&readme, &counts).map_err(|error| format!("{README}: {error}"))
}

fn table(counts: &[Count]) -> String {
    let rows = counts.iter().map(|count| {
        let Count {
            what,
            cycles,
            instructions,
        } = count;
        format!("\n| {what} | {cycles} | {instructions} |")
    });
    format!(
        "| | cycles | instructions |\n|---|---|---|{}",
        rows.collect::<String>()
    )
}

/// Cycles between two bytes at 1 Mbaud and 16 MHz.
const PAUSE: u64 = 160;

/// Bytes that wait in the images' queue at most.
const QUEUE: u64 = 128;

/// Bytes that a turn of the main loop reads at most.
const READ: u64 = 256;

/// Cycles for which our code masks interrupts at most. What the documents of `ztl_mcu::shared` state.
const MASKED: u64 = 1000;

/// What the counts say of the line's rate. The first three are of a received byte, the next of a task's start, the
/// longest time in which no byte is taken from the queue, the last but one of an idle turn, and the last of the longest
/// critical section.
fn rate(counts: &[Count]) -> Outcome<String> {
    let [interrupt, queue, node, start, .., turn, masked] = counts else {
        return Err("the image has counted too little".to_owned());
    };
    if masked.cycles > MASKED {
        return Err(format!(
            "a critical section takes {} cycles, at most {MASKED} are promised",
            masked.cycles
        ));
    }
    let byte = interrupt.cycles + queue.cycles + node.cycles;
    let left = PAUSE.saturating_sub(byte);
    let caught_up = turn.cycles.checked_div(left).unwrap_or(u64::MAX);
    let waiting = (start.cycles + turn.cycles) / PAUSE;
    if caught_up > READ || waiting > QUEUE {
        return Err(format!(
            "at 1 Mbaud and 16 MHz a byte comes every {PAUSE} cycles. One takes {byte}; while a task starts {waiting} come, and \
             {QUEUE} can wait; what a turn takes is caught up after {caught_up} bytes, and one reads {READ}."
        ));
    }
    Ok(format!(
        "At 16 MHz a received byte takes {byte} of the {PAUSE} cycles that it has at 1 Mbaud: a margin of {} %. So {} kbaud \
         can last.\nWhile a task starts {waiting} bytes come, and {QUEUE} can wait; what a turn of the main loop takes besides \
         is caught up after {caught_up} bytes.",
        left * 100 / PAUSE,
        16_000 * 10 / byte,
    ))
}

/// What a README says may be so many percent off: another compiler counts otherwise.
const TOLERANCE: u64 = 10;

/// Whether what the README says between these marks is true.
fn check_counts(readme: &str, counts: &[Count]) -> Outcome {
    let shown = readme
        .split_once("<!-- cycles -->")
        .and_then(|(_, rest)| rest.split_once("<!-- /cycles -->"));
    let Some((shown, _)) = shown else {
        return Err("it shows no cycles, between <!-- cycles --> and <!-- /cycles -->".to_owned());
    };
    let row = |line: &str| -> Option<(String, u64)> {
        let mut cells = line.split('|').map(str::trim);
        let what = cells.nth(1)?.to_owned();
        Some((what, cells.next()?.parse().ok()?))
    };
    let rows: Vec<(String, u64)> = shown.lines().filter_map(row).collect();
    let true_row = |count: &Count| {
        rows.iter().any(|(what, cycles)| {
            *what == count.what && cycles.abs_diff(count.cycles) * 100 <= cycles * TOLERANCE
        })
    };
    match counts.iter().find(|count| !true_row(count)) {
        None if rows.len() == counts.len() => Ok(()),
        _ => Err(format!(
            "it shows other cycles than are counted; between <!-- cycles --> and <!-- /cycles --> \
             there has to be:\n\n{}\n",
            table(counts)
        )),
    }
}

fn cargo(dirs: &Dirs, core: &Core, command: &str, board: &Board) -> Cmd {
    core.cargo(command, &board.target, &dirs.target.join(BUILT))
        .args("--locked --release --manifest-path")
        .arg(MANIFEST)
        .arg("--package")
        .arg(&board.name)
}

fn board(name: &str) -> Outcome<Board> {
    let mut boards = boards()?;
    if let Some(index) = boards.iter().position(|board| board.name == name) {
        return Ok(boards.swap_remove(index));
    }
    let names: Vec<&str> = boards.iter().map(|board| board.name.as_str()).collect();
    Err(format!(
        "there is no board `{name}`; there are: {}",
        names.join(", ")
    ))
}

pub(crate) fn boards() -> Outcome<Vec<Board>> {
    let text =
        fs::read_to_string(BOARDS).map_err(|error| format!("cannot read {BOARDS}: {error}"))?;
    parse(&text)
}

fn parse(text: &str) -> Outcome<Vec<Board>> {
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    let board = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let (name, target, machine) = match words.as_slice() {
            [name, target, "-"] => (name, target, None),
            [name, target, machine @ ..] if !machine.is_empty() => {
                (name, target, Some(machine.join(" ")))
            }
            _ => {
                return Err(format!(
                    "{BOARDS} needs a board, a target and a machine or `-` in each line, not: {line}"
                ));
            }
        };
        Ok(Board {
            name: (*name).to_owned(),
            target: (*target).to_owned(),
            machine,
        })
    };
    lines.map(board).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counts(cycles: &[u64]) -> Vec<Count> {
        let count = |cycles: &u64| Count {
            what: format!("thing of {cycles}"),
            cycles: *cycles,
            instructions: 1,
        };
        cycles.iter().map(count).collect()
    }

    #[test]
    fn a_rate_follows_from_the_counts() {
        let text = rate(&counts(&[70, 20, 38, 8000, 3000, 1600, 1000])).unwrap();
        assert!(text.contains("takes 128 of the 160 cycles"), "{text}");
        assert!(text.contains("a margin of 20 %. So 1250 kbaud"), "{text}");
        assert!(text.contains("starts 60 bytes come"), "{text}");
        assert!(text.contains("after 50 bytes"), "{text}");
        for slow in [
            [100, 20, 40, 8000, 1600, 1000],
            [70, 20, 38, 20_000, 1600, 1000],
            [70, 20, 68, 8000, 1600, 1000],
            [70, 20, 38, 8000, 1600, 1001],
        ] {
            assert!(rate(&counts(&slow)).is_err(), "{slow:?}");
        }
        assert!(rate(&counts(&[100])).is_err());
    }

    #[test]
    fn the_readme_shows_what_is_counted() {
        let readme = |table: &str| format!("x\n<!-- cycles -->\n{table}\n<!-- /cycles -->\n");
        let now = counts(&[100, 30]);
        assert_eq!(check_counts(&readme(&table(&now)), &now), Ok(()));
        let near = table(&now).replace("| 100 |", "| 92 |");
        assert_eq!(check_counts(&readme(&near), &now), Ok(()));
        let far = table(&now).replace("| 100 |", "| 90 |");
        for wrong in [far, table(&counts(&[100])), table(&counts(&[100, 30, 5]))] {
            assert!(check_counts(&readme(&wrong), &now).is_err(), "{wrong}");
        }
        assert!(check_counts("x", &now).is_err());
    }

    #[test]
    fn a_board_is_a_line() {
        let boards =
            parse("# x\nmicrobit thumbv6m-none-eabi  qemu-system-arm -M microbit\npico t -");
        let board = |name: &str, target: &str, machine: Option<&str>| Board {
            name: name.to_owned(),
            target: target.to_owned(),
            machine: machine.map(str::to_owned),
        };
        assert_eq!(
            boards.unwrap(),
            [
                board(
                    "microbit",
                    "thumbv6m-none-eabi",
                    Some("qemu-system-arm -M microbit")
                ),
                board("pico", "t", None),
            ]
        );
        let message = parse("pico t").unwrap_err();
        assert!(message.ends_with("not: pico t"), "{message}");
    }
}
