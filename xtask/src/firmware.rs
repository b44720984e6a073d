//! `cargo xtask firmware` and `cargo xtask qemu`: the images of `examples/firmware`, one a board.

use std::fs;
use std::path::PathBuf;

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};
use crate::cross::Core;
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

/// Instructions by which the UART's interrupt gets at a byte.
const HANDLER: u32 = 15;

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
    Ok(())
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

/// Counts the instructions of a Cortex-M0: in QEMU, where each takes the same time.
pub(crate) fn bench(dirs: &Dirs) -> Outcome {
    tools::provide_qemu()?;
    image::check_lock(MANIFEST)?;
    let image = build_image(dirs, &board(WEIGHED)?, &format!("{WEIGHED}-bench"), QUIET)?;
    let qemu = Cmd::new("qemu-system-arm -M microbit -nographic -monitor none -serial stdio")
        .args("-semihosting -icount shift=6 -kernel")
        .arg(image);
    println!("$ {qemu}");
    let counts = qemu.stdout()?;
    println!("\nInstructions of a Cortex-M0, optimised for size:\n\n{counts}\n");
    println!("{}", rate(&counts)?);
    Ok(())
}

/// What the counts of a received byte, which come first, say of the line's rate.
fn rate(counts: &str) -> Outcome<String> {
    let count = |line: &str| line.split(' ').next()?.parse::<u32>().ok();
    let bytes: Option<Vec<u32>> = counts.lines().take(3).map(count).collect();
    let bytes = bytes.filter(|bytes| bytes.len() == 3);
    let bytes = bytes.ok_or_else(|| format!("the image has counted nothing: `{counts}`"))?;
    // 3 cycles to 2 instructions; 32 to enter and leave the interrupt.
    let interrupt = (bytes.iter().take(1).sum::<u32>() + HANDLER) * 3 / 2 + 32;
    let all = (bytes.iter().sum::<u32>() + HANDLER) * 3 / 2 + 32;
    Ok(format!(
        "At 16 MHz, with 3 cycles to 2 instructions, {HANDLER} instructions for the UART's registers and 32 cycles to \
         enter and leave its interrupt,\na byte takes {all} cycles, of which the interrupt has {interrupt}. At 1 Mbaud \
         one comes every 160: the interrupt keeps up\n(margin {} %), and what the main loop leaves of a frame waits in \
         the queue; without a pause, {} kbaud can be taken.",
        (160 - i64::from(interrupt)) * 100 / 160,
        160_000 / all,
    ))
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

    #[test]
    fn a_rate_follows_from_the_first_three_counts() {
        let text = rate("55 in\n17 out\n56 node\n9000 start").unwrap();
        assert!(
            text.contains("a byte takes 246 cycles, of which the interrupt has 137."),
            "{text}"
        );
        assert!(text.contains("without a pause, 650 kbaud"), "{text}");
        assert!(rate("qemu: no").is_err());
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
