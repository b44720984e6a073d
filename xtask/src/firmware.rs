//! `cargo xtask firmware` and `cargo xtask qemu`: the images of `examples/firmware`.

use std::path::PathBuf;
use std::process::Command;

use anyhow::{Context as _, Result, bail, ensure};
use xshell::Shell;

use crate::cross::Core;
use crate::image::Image;
use crate::project::Project;
use crate::{cycles, install, lock};

/// The packages of the boards, which are not in the workspace.
pub(crate) const MANIFEST: &str = "examples/firmware/Cargo.toml";

/// The list of boards.
const BOARDS: &str = "examples/firmware/boards.txt";

/// The board whose images are measured.
const MEASURED: &str = "microbit";

/// An image with a network stack, and the feature that it needs.
const NETWORKED: &str = "ethernet";

/// An image with an async driver, and the feature that it needs.
const ASYNC: &str = "async";

/// An RTIC app with a serial port by DMA, and the feature that it needs.
const RTIC: &str = "rtic";

/// The lamp by postcard-rpc, to compare with, and the feature that it needs.
const POSTCARD: &str = "postcard";

/// An image that saves parameters in flash, and the feature that it needs.
const FLASH: &str = "flash";

/// The bootloader, images that are updated with it, and the feature that all of them need.
const BOOT: &str = "boot";
const UPDATABLE: [&str; 2] = ["update", "updated"];

/// Boards with further images, which log nothing: the robot, the same with descriptions, the smallest useful node, the same
/// on a shared line and by another project, with an async driver, with a button, with parameters, with parameters that are saved, a
/// bootloader and two versions of a lamp for it, a bare serial port, and
/// servers for ZeroMQ clients without a gateway; an I2C servo driver, and the robot as an RTIC app.
const MORE: &[(&str, &[&str])] = &[
    (
        MEASURED,
        &[
            "quiet",
            "described",
            "smallest",
            "bus",
            POSTCARD,
            ASYNC,
            "button",
            "parameters",
            FLASH,
            BOOT,
            UPDATABLE[0],
            UPDATABLE[1],
            "uart",
            "zmtp",
        ],
    ),
    ("lm3s6965evb", &["zmtp", NETWORKED]),
    ("mps2-an386", &["uart", "zmtp"]),
    ("pico", &["pca9685"]),
    ("nucleo-f401re", &[RTIC]),
];

/// A line of [`BOARDS`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Board {
    pub(crate) name: String,
    pub(crate) target: String,
    /// The program and arguments that run it in QEMU, without the image; empty if QEMU cannot.
    pub(crate) machine: Vec<String>,
}

/// Builds one board's images, or all, and prints their sizes.
pub(crate) fn show(project: &Project, name: Option<&str>) -> Result<()> {
    let boards = match name {
        Some(name) => vec![board(&project.sh, name)?],
        None => boards(&project.sh)?,
    };
    for board in boards {
        for path in build(project, &board)? {
            let Image { flash, ram, .. } = Image::read(&path)?;
            let path = path.display();
            println!("{path}: {flash} bytes of flash, {ram} of static RAM");
        }
    }
    Ok(())
}

/// Builds one board's image and runs it in QEMU, until QEMU is stopped.
pub(crate) fn run_in_qemu(project: &Project, name: &str, port: u16) -> Result<()> {
    let board = board(&project.sh, name)?;
    let [program, machine @ ..] = board.machine.as_slice() else {
        bail!("QEMU has no {name}; its README says how to flash one");
    };
    install::qemu(&project.sh)?;
    let image = build_image(project, &board, name, &[])?;
    let elf = image.display();
    println!(
        "\n{name} runs, with its serial port at TCP port {port}. In another terminal:\n\n    \
         cargo run --bin ztl -- gateway -d desk=tcp:127.0.0.1:{port} -p 12345 -s /lab --elf desk={elf}\n    \
         cargo run --bin ztl -- task-client -r localhost -p 12345 -s /lab desk:stage:home\n\n\
         Ctrl-A X stops QEMU."
    );
    // Not by the shell of xshell, which passes no keys.
    let serial = format!("tcp:127.0.0.1:{port},server=on,wait=off,nodelay=on");
    let mut qemu = Command::new(program);
    qemu.args(machine)
        .args(["-nographic", "-monitor", "none", "-serial", &serial]);
    let status = qemu.arg("-kernel").arg(image).status()?;
    ensure!(status.success(), "QEMU: {status}");
    Ok(())
}

/// Whether an image has much code that is not ours and may panic or format text: a network stack, embassy's HAL,
/// postcard-rpc, `sequential-storage`, `embassy-boot`.
pub(crate) fn has_foreign_code(image: &str) -> bool {
    [NETWORKED, POSTCARD, FLASH, BOOT]
        .iter()
        .chain(&UPDATABLE)
        .any(|name| image.ends_with(name))
        || image.starts_with("pico")
}

/// The feature that an image needs, if any.
fn feature(image: &'static str) -> Option<&'static str> {
    if UPDATABLE.contains(&image) {
        return Some(BOOT);
    }
    [NETWORKED, ASYNC, FLASH, RTIC, POSTCARD, BOOT]
        .into_iter()
        .find(|feature| *feature == image)
}

/// Whether an image has async functions.
pub(crate) fn is_async(image: &str) -> bool {
    image.ends_with(ASYNC)
}

/// Lints and builds all of them, and counts cycles.
pub(crate) fn check(project: &Project) -> Result<()> {
    for board in boards(&project.sh)? {
        // Debian's compiler is not the one that clippy belongs to.
        if let core @ Core::Compiled(_) = Core::provide(&project.sh, &board.target)? {
            let mut special: Vec<_> = images(&board)
                .iter()
                .filter_map(|image| feature(image))
                .collect();
            special.dedup();
            let features = special
                .into_iter()
                .map(|feature| vec!["--features", feature]);
            for features in core::iter::once(Vec::new()).chain(features) {
                let clippy = core.cargo(project, "clippy", &board.target, "firmware")?;
                let clippy = clippy.args(["--release", "--manifest-path", MANIFEST, "--package"]);
                let clippy = clippy.arg(&board.name).args(features);
                clippy.args(["--", "-D", "warnings"]).run()?;
            }
        }
        build(project, &board)?;
    }
    bench(project)
}

/// Builds all that the tests run.
pub(crate) fn build_for_qemu(project: &Project) -> Result<()> {
    let mut boards = boards(&project.sh)?;
    boards.retain(|board| !board.machine.is_empty());
    let mut built = boards.iter().map(|board| build(project, board));
    built.try_for_each(|built| built.map(drop))
}

/// Builds a board's images: the paths of their ELF files, the robot's first.
pub(crate) fn build(project: &Project, board: &Board) -> Result<Vec<PathBuf>> {
    let mut paths = vec![build_image(project, board, &board.name, &[])?];
    for image in images(board) {
        // They do not log.
        let mut features = vec!["--no-default-features"];
        if let Some(feature) = feature(image) {
            features.extend(["--features", feature]);
        }
        let image = format!("{}-{image}", board.name);
        paths.push(build_image(project, board, &image, &features)?);
    }
    Ok(paths)
}

/// A board's further images.
fn images(board: &Board) -> &'static [&'static str] {
    let more = MORE.iter().find(|(name, _)| *name == board.name);
    more.map_or(&[], |(_, images)| images)
}

fn build_image(
    project: &Project,
    board: &Board,
    image: &str,
    features: &[&str],
) -> Result<PathBuf> {
    lock::check(&project.sh, MANIFEST)?;
    let core = Core::provide(&project.sh, &board.target)?;
    let build = core.cargo(project, "build", &board.target, "firmware")?;
    let build = build.args(["--release", "--manifest-path", MANIFEST, "--package"]);
    build
        .args([&board.name, "--bin", image])
        .args(features)
        .run()?;
    let built = project.target.join("firmware").join(&board.target);
    Ok(built.join("release").join(image))
}

/// Builds the images of the board that is measured, and whose power is cut.
pub(crate) fn build_measured(project: &Project) -> Result<()> {
    build(project, &board(&project.sh, MEASURED)?).map(drop)
}

/// Counts the cycles that a Cortex-M0 needs for a byte and for a task, and compares them with the README.
pub(crate) fn bench(project: &Project) -> Result<()> {
    install::qemu(&project.sh)?;
    let board = board(&project.sh, MEASURED)?;
    let build = |image: &str, feature| {
        let image = format!("{MEASURED}-{image}");
        let features = ["--no-default-features", "--features", feature];
        build_image(project, &board, &image, &features)
    };
    cycles::check(project, &build("bench", BOOT)?, &build("masked", ASYNC)?)
}

fn board(sh: &Shell, name: &str) -> Result<Board> {
    let boards = boards(sh)?;
    let names: Vec<&str> = boards.iter().map(|board| board.name.as_str()).collect();
    let found = boards.iter().find(|board| board.name == name).cloned();
    let names = names.join(", ");
    found.with_context(|| format!("unknown board `{name}`: expected one of {names}"))
}

pub(crate) fn boards(sh: &Shell) -> Result<Vec<Board>> {
    parse(&sh.read_file(BOARDS)?).context(BOARDS)
}

fn parse(text: &str) -> Result<Vec<Board>> {
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    let board = |line: &str| {
        let mut words = line.split_whitespace().map(str::to_owned);
        let (name, target, machine) = (words.next(), words.next(), words.collect::<Vec<_>>());
        match (name, target, machine.as_slice()) {
            (Some(name), Some(target), [first, ..]) => {
                let machine = if first == "-" { Vec::new() } else { machine };
                Ok(Board {
                    name,
                    target,
                    machine,
                })
            }
            _ => bail!("invalid line `{line}`: expected a board, a target, and a machine or `-`"),
        }
    };
    lines.map(board).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_board_is_one_line() {
        let boards = parse("# x\nmicrobit thumbv6m  qemu-system-arm -M microbit\npico t -");
        let [microbit, pico] = boards.unwrap().try_into().unwrap();
        let Board { name, target, .. } = &microbit;
        assert_eq!([name, target], ["microbit", "thumbv6m"]);
        assert_eq!(microbit.machine, ["qemu-system-arm", "-M", "microbit"]);
        assert_eq!((pico.name.as_str(), pico.machine.len()), ("pico", 0));
        let message = parse("pico t").unwrap_err().to_string();
        assert!(message.contains("`pico t`"), "{message}");
    }
}
