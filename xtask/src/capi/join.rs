//! Links everything that a library needs into one object, and hides all names except those in its header.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail};
use object::{Object, ObjectSymbol};
use xshell::{Shell, cmd};

use crate::install;

pub(super) const HEADER: &str = "ztl-c/include/ztl.h";

/// LLVM bitcode in Rust's standard library, for link-time optimisation; a linker with another LLVM version
/// rejects it.
const BITCODE: [&str; 4] = [
    "--remove-section",
    ".llvmbc",
    "--remove-section",
    ".llvmcmd",
];

/// GNU's binutils for a processor.
pub(super) struct Tools {
    /// Prefix of their names.
    pub(super) prefix: &'static str,
    /// Options for the linker.
    pub(super) linker: &'static [&'static str],
    /// Options for `objcopy`, before names are hidden.
    pub(super) unmark: &'static [&'static str],
    /// Names that stay visible, as weak symbols, besides those in the header: functions of the compiler's
    /// runtime library that the target's C++ library needs.
    pub(super) runtime: &'static [&'static str],
}

impl Tools {
    /// GNU's linker without options, for a target without C++.
    pub(super) const BARE: Self = Self {
        prefix: "",
        linker: &[],
        unmark: &[],
        runtime: &[],
    };

    /// For this machine.
    pub(super) const HOST: Self = Self {
        // GNU's C++ marks some names as unique in the process, which `objcopy` does not hide. Only if the C++
        // library is included: otherwise missing names would become weak and stay 0.
        unmark: &["--wildcard", "--weaken-symbol", "_Z*"],
        ..Self::BARE
    };
}

/// Creates a static library of everything that the header's functions need from these archives, and copies
/// the header to `include/` next to it. Returns the single object in it.
pub(super) fn join(
    sh: &Shell,
    tools: &Tools,
    header: &str,
    archives: &[PathBuf],
    library: &Path,
) -> Result<PathBuf> {
    let Tools {
        prefix,
        linker,
        unmark,
        runtime,
    } = *tools;
    if !install::has(sh, &format!("{prefix}ld")) {
        let package = format!("binutils-{prefix}");
        install::install(sh, package.trim_end_matches('-'))?;
    }
    let lib = library.parent().context("a library is in a directory")?;
    sh.create_dir(lib)?;
    let include = sh.create_dir(lib.with_file_name("include"))?;
    sh.copy_file(header, include)?;
    let text = sh.read_file(header)?;
    let mut symbols = functions(&text);
    symbols.extend(runtime);
    let [listed, all, weak, object] =
        ["symbols", "all.o", "weak.o", "o"].map(|end| library.with_extension(end));
    sh.write_file(&listed, symbols.join("\n") + "\n")?;

    // No section groups: another program's C++ could replace them.
    let wanted = symbols.iter().flat_map(|symbol| ["-u", symbol]);
    let link = ["-r", "--force-group-allocation", "--gc-sections"];
    let link = link.iter().chain(linker);
    cmd!(
        sh,
        "{prefix}ld {link...} {wanted...} -o {all} {archives...}"
    )
    .run()?;
    let weaken = runtime.iter().flat_map(|name| ["--weaken-symbol", name]);
    let strip = cmd!(sh, "{prefix}objcopy --strip-debug {unmark...} {BITCODE...}");
    strip.args(weaken).args([&all, &weak]).run()?;
    let keep = format!("--keep-global-symbols={}", listed.display());
    cmd!(sh, "{prefix}objcopy {keep} {weak} {object}").run()?;
    // `ar` would add to an old archive.
    sh.remove_path(library)?;
    cmd!(sh, "{prefix}ar crs {library} {object}").run()?;
    for done in [listed, all, weak] {
        sh.remove_path(done)?;
    }
    shows_only(sh, &object, &symbols)?;
    Ok(object)
}

/// Checks that an object or shared library exports these functions and nothing else.
pub(super) fn shows_only(sh: &Shell, path: &Path, symbols: &[&str]) -> Result<()> {
    let (bytes, path) = (sh.read_binary_file(path)?, path.display());
    let file = object::File::parse(&*bytes)?;
    let seen = file.symbols().chain(file.dynamic_symbols());
    let seen = seen.filter(|symbol| symbol.is_global() && symbol.is_definition());
    let seen: BTreeSet<&str> = seen.filter_map(|symbol| symbol.name().ok()).collect();
    let wanted: BTreeSet<&str> = symbols.iter().copied().collect();
    match wanted.symmetric_difference(&seen).next() {
        None => Ok(()),
        Some(other) if seen.contains(other) => bail!("{path} also exports `{other}`"),
        Some(lacking) => bail!("{path} does not export `{lacking}`"),
    }
}

/// The names of the functions declared in a header.
pub(super) fn functions(header: &str) -> Vec<&str> {
    let is_name = |c: char| c.is_ascii_lowercase() || c == '_';
    // Lines of comments begin with a space; a declaration's first line does not.
    let lines = header
        .lines()
        .filter(|line| !line.starts_with([' ', '#', '/']));
    let names = lines.filter_map(|line| {
        let (before, _) = line.split_once('(')?;
        before.rsplit(|c| !is_name(c)).next()
    });
    names.filter(|name| name.starts_with("ztl_")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn functions_are_found_among_types_and_comments() {
        let header = "/**\n * See ztl_not(this).\n */\nint ztl_first(int a,\n              int b);\n\
                      typedef void (*ztl_call)(void *context);\nconst char *ztl_second(void);\n";
        assert_eq!(functions(header), ["ztl_first", "ztl_second"]);
    }
}
