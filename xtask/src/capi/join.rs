//! Links everything that a library needs into one object, and hides all names except those in its header.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fmt::Display;
use std::fs;
use std::path::{Path, PathBuf};

use object::{Object, ObjectSymbol};

use crate::cmd::{Cmd, Outcome};

/// LLVM bitcode in Rust's standard library, for link-time optimisation; a linker with another LLVM version
/// rejects it.
const BITCODE: &str = "--remove-section .llvmbc --remove-section .llvmcmd";

/// GNU's binutils for a processor.
pub(super) struct Tools {
    /// Prefix of their names.
    pub(super) prefix: &'static str,
    /// Option for the linker.
    pub(super) emulation: &'static str,
    /// Option for `objcopy`, before names are hidden.
    pub(super) unmark: &'static str,
    /// Names that stay visible, as weak symbols, besides those in the header: functions of the compiler's
    /// runtime library that the target's C++ library needs.
    pub(super) runtime: &'static [&'static str],
}

impl Tools {
    /// For this machine.
    pub(super) const HOST: Self = Self {
        prefix: "",
        emulation: "",
        // GNU's C++ marks some names as unique in the process, which `objcopy` does not hide. Only if the C++
        // library is included: otherwise missing names would become weak and stay 0.
        unmark: "--wildcard --weaken-symbol _Z*",
        runtime: &[],
    };

    fn command(&self, name: &str) -> Cmd {
        Cmd::program(format!("{}{name}", self.prefix))
    }
}

/// Creates a static library of everything that the header's functions need from these archives, and copies
/// the header to `include/` next to it. Returns the single object in it.
pub(super) fn join(
    tools: &Tools,
    header: &str,
    archives: &[PathBuf],
    library: &Path,
) -> Outcome<PathBuf> {
    let failed = |error| format!("cannot write {}: {error}", library.display());
    let lib = library.parent().ok_or("a library lies in a directory")?;
    let include = lib.with_file_name("include");
    for directory in [lib, &include] {
        fs::create_dir_all(directory).map_err(failed)?;
    }
    let text = fs::read_to_string(header).map_err(|error| format!("{header}: {error}"))?;
    let name = Path::new(header).file_name().unwrap_or_default();
    fs::write(include.join(name), &text).map_err(failed)?;
    let mut symbols = functions(&text);
    symbols.extend(tools.runtime);
    let [listed, all, weak, object] =
        ["symbols", "all.o", "weak.o", "o"].map(|end| library.with_extension(end));
    fs::write(&listed, symbols.join("\n") + "\n").map_err(failed)?;

    // No section groups: another program's C++ could replace them.
    let mut link = tools
        .command("ld")
        .args("-r --force-group-allocation --gc-sections")
        .args(tools.emulation);
    for symbol in &symbols {
        link = link.arg("-u").arg(symbol);
    }
    link = link.arg("-o").arg(&all);
    for archive in archives {
        link = link.arg(archive);
    }
    link.run()?;
    let mut weaken = tools
        .command("objcopy")
        .arg("--strip-debug")
        .args(tools.unmark)
        .args(BITCODE);
    for symbol in tools.runtime {
        weaken = weaken.arg("--weaken-symbol").arg(symbol);
    }
    weaken.arg(&all).arg(&weak).run()?;
    let mut keep = OsString::from("--keep-global-symbols=");
    keep.push(&listed);
    let hide = tools.command("objcopy").arg(keep);
    hide.arg(&weak).arg(&object).run()?;
    // `ar` would add to an old archive.
    let _ = fs::remove_file(library);
    tools
        .command("ar")
        .arg("crs")
        .arg(library)
        .arg(&object)
        .run()?;
    for done in [listed, all, weak] {
        fs::remove_file(done).map_err(failed)?;
    }
    shows_only(&object, &symbols)?;
    Ok(object)
}

/// Checks that an object or shared library exports these functions and nothing else.
pub(super) fn shows_only(path: &Path, symbols: &[&str]) -> Outcome {
    let failed = |error: &dyn Display| format!("{}: {error}", path.display());
    let bytes = fs::read(path).map_err(|error| failed(&error))?;
    let file = object::File::parse(&*bytes).map_err(|error| failed(&error))?;
    let seen = file.symbols().chain(file.dynamic_symbols());
    let seen = seen.filter(|symbol| symbol.is_global() && symbol.is_definition());
    let seen: BTreeSet<&str> = seen.filter_map(|symbol| symbol.name().ok()).collect();
    let wanted: BTreeSet<&str> = symbols.iter().copied().collect();
    match (
        wanted.difference(&seen).next(),
        seen.difference(&wanted).next(),
    ) {
        (None, None) => Ok(()),
        (Some(lacking), _) => Err(failed(&format!("`{lacking}` is missing"))),
        (_, Some(other)) => Err(failed(&format!("`{other}` is exported too"))),
    }
}

/// The names of the functions declared in a header.
pub(super) fn functions(header: &str) -> Vec<&str> {
    let is_name = |c: char| c.is_ascii_lowercase() || c == '_';
    // Lines of comments begin with a space; a declaration's first line does not.
    let lines = header.lines();
    let lines = lines.filter(|line| !line.starts_with([' ', '#', '/']));
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
