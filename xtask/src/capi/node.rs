//! The library for firmware in C, and its example.

use std::path::Path;

use anyhow::{Context as _, Result, bail};
use object::{Object, ObjectSymbol};
use xshell::cmd;

use super::join::{self, Tools};
use crate::bare::NODE;
use crate::cross::Core;
use crate::lock;
use crate::project::Project;

const HEADER: &str = "ztl-node-c/include/ztl_node.h";

/// Referenced only by the panic handler.
const PANIC: &str = "ztl_a_panic_is_reachable";

/// Builds the library for a target, or for this machine to test firmware on it.
pub(super) fn assemble(project: &Project, target: Option<&str>, place: &Path) -> Result<()> {
    let sh = &project.sh;
    lock::check(sh, NODE)?;
    let below = project.target.join("node");
    let build = match target {
        None => project.cargo("build --target-dir").arg(&below),
        Some(target) => Core::provide(sh, target)?.cargo(project, "build", target, "node")?,
    };
    build.args(["--release", "--manifest-path", NODE]).run()?;
    let (prefix, linker) = match target {
        None => ("", &[][..]),
        Some(target) if target.starts_with("thumb") => ("arm-none-eabi-", &[][..]),
        Some(target) if target.starts_with("riscv32") => {
            ("riscv64-unknown-elf-", &["-m", "elf32lriscv"][..])
        }
        Some(target) => bail!("no linker for {target} is known: build {NODE} with cargo instead"),
    };
    let tools = match target {
        None => Tools::HOST,
        Some(_) => Tools {
            prefix,
            linker,
            ..Tools::BARE
        },
    };
    let built = below.join(target.unwrap_or_default());
    let built = [built.join("release/libztl_node_c.a")];
    let library = place.join("lib/libztl_node.a");
    let object = join::join(sh, &tools, HEADER, &built, &library)?;
    let bytes = sh.read_binary_file(&object)?;
    let file = object::File::parse(&*bytes).with_context(|| object.display().to_string())?;
    if file.symbols().any(|symbol| symbol.name() == Ok(PANIC)) {
        let object = object.display();
        bail!(
            "a panic is reachable in {object}: `cargo xtask test --only proof` shows where, unless it is in ztl-node-c"
        );
    }
    println!("no panic is reachable");
    Ok(sh.remove_path(object)?)
}

/// Builds the example's firmware, also as C++, into the directory where the tests look for board images.
pub(super) fn build_firmware(project: &Project, place: &Path, built: &Path) -> Result<()> {
    const TARGET: &str = "thumbv7m-none-eabi";
    const BOARD: &str = "examples/c/firmware/lm3s6965evb";
    let sh = &project.sh;
    let place = place.join(TARGET);
    assemble(project, Some(TARGET), &place)?;
    let images = sh.create_dir(built.join("firmware").join(TARGET).join("release"))?;
    let compile = "-pedantic -Wall -Wextra -Werror -Os -ffreestanding -fno-tree-loop-distribute-patterns \
        -mcpu=cortex-m3 -mthumb";
    let link = "-x none -nostdlib -Wl,--gc-sections -Wl,-z,noexecstack -T";
    for (language, end) in [
        ("c -std=c89", "c"),
        ("c++ -std=c++98 -fno-exceptions -fno-rtti", "cpp"),
    ] {
        let image = images.join(format!("lm3s6965evb-{end}"));
        let [language, compile, link] = [language, compile, link].map(str::split_whitespace);
        cmd!(
            sh,
            "arm-none-eabi-gcc -x {language...} {compile...} -I {place}/include {BOARD}.c examples/c/firmware/robot.c
             {link...} {BOARD}.ld {place}/lib/libztl_node.a -lgcc -o {image}"
        )
        .run()?;
        cmd!(sh, "arm-none-eabi-size {image}").run()?;
    }
    Ok(())
}
