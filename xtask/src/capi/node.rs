//! The library for firmware in C, and its example.

use std::fs;
use std::path::Path;

use object::{Object, ObjectSymbol};

use super::join::{self, Tools};
use crate::cmd::{Cmd, Outcome};
use crate::cross::Core;
use crate::{Dirs, image, tools};

/// The node's package, which is not in the workspace.
pub(crate) const MANIFEST: &str = "ztl-node-c/Cargo.toml";
const HEADER: &str = "ztl-node-c/include/ztl_node.h";

/// Referenced only by the panic handler.
const PANIC: &str = "ztl_a_panic_is_reachable";

/// The example's board: its name, target and compiler options.
const FIRMWARE: &str = "examples/c/firmware";
const BOARD: &str = "lm3s6965evb";
const TARGET: &str = "thumbv7m-none-eabi";
const CPU: &str = "-mcpu=cortex-m3 -mthumb";

/// Builds the library for a target, or for this machine to test firmware on it.
pub(super) fn assemble(dirs: &Dirs, target: Option<&str>, place: &Path) -> Outcome {
    image::check_lock(MANIFEST)?;
    let below = dirs.target.join("node");
    let build = match target {
        None => Cmd::new("cargo build --target-dir").arg(&below),
        Some(target) => Core::provide(target)?.cargo("build", target, &below),
    };
    build
        .args("--release --locked --manifest-path")
        .arg(MANIFEST)
        .run()?;
    let gnu = match target.map(|target| target.split('-').next().unwrap_or_default()) {
        None => Tools::HOST,
        Some(arm) if arm.starts_with("thumb") => Tools {
            prefix: "arm-none-eabi-",
            emulation: "",
            unmark: "",
            runtime: &[],
        },
        Some(riscv) if riscv.starts_with("riscv32") => Tools {
            prefix: "riscv64-unknown-elf-",
            emulation: "-m elf32lriscv",
            unmark: "",
            runtime: &[],
        },
        Some(other) => {
            return Err(format!(
                "no linker for {other} is known; build {MANIFEST} with cargo instead"
            ));
        }
    };
    if !tools::has(&format!("{}ld", gnu.prefix)) {
        tools::install(&[&format!("binutils-{}", gnu.prefix.trim_end_matches('-'))])?;
    }
    let built = target.map_or_else(|| below.clone(), |target| below.join(target));
    let archives = [built.join("release/libztl_node_c.a")];
    let library = place.join("lib/libztl_node.a");
    let object = join::join(&gnu, HEADER, &archives, &library)?;
    prove(&object)?;
    let removed = fs::remove_file(&object);
    removed.map_err(|error| format!("{}: {error}", object.display()))
}

/// Checks that nothing in the object can panic.
fn prove(object: &Path) -> Outcome {
    let bytes = fs::read(object).map_err(|error| format!("{}: {error}", object.display()))?;
    let file =
        object::File::parse(&*bytes).map_err(|error| format!("{}: {error}", object.display()))?;
    if file.symbols().any(|symbol| symbol.name() == Ok(PANIC)) {
        return Err(format!(
            "a panic is reachable in {}; `cargo xtask proof` shows where, unless it is in ztl-node-c itself",
            object.display()
        ));
    }
    println!("no panic is reachable");
    Ok(())
}

/// Builds the example's firmware, also as C++, into the directory where the tests look for board images.
pub(super) fn build_firmware(dirs: &Dirs, target: &Path) -> Outcome {
    let place = dirs.target.join("c-test").join(TARGET);
    assemble(dirs, Some(TARGET), &place)?;
    let images = target.join("firmware").join(TARGET).join("release");
    fs::create_dir_all(&images).map_err(|error| format!("{}: {error}", images.display()))?;
    for (language, end) in [
        ("c -std=c89", "c"),
        ("c++ -std=c++98 -fno-exceptions -fno-rtti", "cpp"),
    ] {
        let image = images.join(format!("{BOARD}-{end}"));
        Cmd::new("arm-none-eabi-gcc -x")
            .args(language)
            .args("-pedantic -Wall -Wextra -Werror -Os -ffreestanding -fno-tree-loop-distribute-patterns")
            .args(CPU)
            .arg("-I")
            .arg(place.join("include"))
            .arg(format!("{FIRMWARE}/{BOARD}.c"))
            .arg(format!("{FIRMWARE}/robot.c"))
            .args("-x none -nostdlib -Wl,--gc-sections -Wl,-z,noexecstack -T")
            .arg(format!("{FIRMWARE}/{BOARD}.ld"))
            .arg(place.join("lib/libztl_node.a"))
            .args("-lgcc -o")
            .arg(&image)
            .run()?;
        Cmd::new("arm-none-eabi-size").arg(&image).run()?;
    }
    Ok(())
}
