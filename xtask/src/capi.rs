//! `cargo xtask c`: the libraries for programs in C, with their headers.
//!
//! What cargo makes of `ztl-c` has the names of libzmq, libsodium, C++ and Rust in it, which would clash with
//! those of a robot's program. So all of it is linked into one object in which only the functions of
//! `ztl.h` can be seen; of that the static and the shared library are made.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;

use crate::cmd::{Cmd, Outcome};
use crate::{Dirs, curve, python};

const HEADER: &str = "ztl-c/include/ztl.h";

/// The shared library's name has the number of its interface, `ZTL_ABI`.
const ABI: &str = "1";

/// What a program links to besides.
const SYSTEM: &str = "-lpthread -ldl -lm -lrt";

/// What rustc leaves in its standard library for optimising it once more; a linker of another LLVM
/// stumbles over it.
const BITCODE: &str = "--remove-section .llvmbc --remove-section .llvmcmd";

/// Makes the libraries of this machine.
pub(crate) fn run(dirs: &Dirs, args: &[String]) -> Outcome {
    if !args.is_empty() {
        return Err("`cargo xtask c` takes nothing".to_owned());
    }
    curve::cargo(dirs, "build")?
        .args("--release --locked --package ztl-c")
        .env("CARGO_PROFILE_RELEASE_LTO", "fat")
        .env("CARGO_PROFILE_RELEASE_CODEGEN_UNITS", "1")
        .env("CARGO_PROFILE_RELEASE_DEBUG", "false")
        .run()?;
    let place = dirs.target.join("c");
    assemble(&curve::target(dirs).join("release/libztl_c.a"), &place)?;
    for name in ["libztl.a", &shared()] {
        let path = place.join("lib").join(name);
        println!("{}: {} bytes", path.display(), size(&path)?);
    }
    println!("{}", place.join("include/ztl.h").display());
    Ok(())
}

/// Runs the examples and the tests in C, with encryption, checked from all sides.
pub(crate) fn test(dirs: &Dirs) -> Outcome {
    let python = python::ensure(dirs)?;
    curve::cargo(dirs, "build")?
        .args("--locked --package ztl-c --package ztl-std --bin ztl --lib")
        .run()?;
    let place = dirs.target.join("c-test");
    assemble(&curve::target(dirs).join("debug/libztl_c.a"), &place)?;
    curve::cargo(dirs, "test")?
        .args("--locked --package ztl-c")
        .env("ZTL_PYTHON", python)
        .env("ZTL_CURVE", "1")
        .env("ZTL_C", dirs.absolute("c-test"))
        .run()
}

fn shared() -> String {
    format!("libztl.so.{ABI}")
}

fn size(path: &Path) -> Outcome<u64> {
    let metadata = fs::metadata(path);
    let metadata = metadata.map_err(|error| format!("{}: {error}", path.display()))?;
    Ok(metadata.len())
}

/// Makes `include/` and `lib/` of what cargo has made.
fn assemble(archive: &Path, place: &Path) -> Outcome {
    let failed = |error| format!("cannot write {}: {error}", place.display());
    let (include, lib, work) = (place.join("include"), place.join("lib"), place.join("work"));
    for directory in [&include, &lib.join("pkgconfig"), &work] {
        fs::create_dir_all(directory).map_err(failed)?;
    }
    let header = fs::read_to_string(HEADER).map_err(|error| format!("{HEADER}: {error}"))?;
    fs::write(include.join("ztl.h"), &header).map_err(failed)?;
    let symbols = functions(&header);
    let listed = work.join("symbols");
    fs::write(&listed, symbols.join("\n") + "\n").map_err(failed)?;

    // All that these functions need: nothing else of it, and no group that another program's C++ could
    // take the place of.
    let [all, weak, object] = ["all.o", "weak.o", "ztl.o"].map(|name| work.join(name));
    let mut link = Cmd::new("ld -r --force-group-allocation --gc-sections");
    for symbol in &symbols {
        link = link.arg("-u").arg(symbol);
    }
    link = link.arg("-o").arg(&all).arg(archive);
    for (compiler, name) in [
        ("c++", "libstdc++.a"),
        ("cc", "libgcc_eh.a"),
        ("cc", "libgcc.a"),
    ] {
        let path = Cmd::new(compiler).arg(format!("-print-file-name={name}"));
        link = link.arg(path.stdout()?);
    }
    link.run()?;
    // C++ marks some names as the only ones in the whole process; that is taken from them first.
    Cmd::new("objcopy --strip-debug --wildcard --weaken-symbol _Z*")
        .args(BITCODE)
        .arg(&all)
        .arg(&weak)
        .run()?;
    let mut keep = std::ffi::OsString::from("--keep-global-symbols=");
    keep.push(&listed);
    Cmd::new("objcopy")
        .arg(keep)
        .arg(&weak)
        .arg(&object)
        .run()?;

    let archive = lib.join("libztl.a");
    // `ar` would add to an older one.
    let _ = fs::remove_file(&archive);
    Cmd::new("ar crs").arg(&archive).arg(&object).run()?;
    let shared = shared();
    Cmd::new("cc -shared -Wl,-z,defs -Wl,--gc-sections -s")
        .arg(format!("-Wl,-soname,{shared}"))
        .arg("-o")
        .arg(lib.join(&shared))
        .arg(&object)
        .args(SYSTEM)
        .run()?;
    let link = lib.join("libztl.so");
    let _ = fs::remove_file(&link);
    symlink(&shared, &link).map_err(failed)?;
    fs::write(lib.join("pkgconfig/ztl.pc"), pkg_config()).map_err(failed)?;
    fs::remove_dir_all(&work).map_err(failed)
}

/// Found wherever the directory is put.
fn pkg_config() -> String {
    format!(
        "prefix=${{pcfiledir}}/../..\n\n\
         Name: ztl\n\
         Description: serve tasks to ZTL's clients, and have tasks done\n\
         Version: {version}\n\
         Cflags: -I${{prefix}}/include\n\
         Libs: -L${{prefix}}/lib -lztl\n\
         Libs.private: {SYSTEM}\n",
        version = env!("CARGO_PKG_VERSION"),
    )
}

/// The names of the functions that a header declares.
fn functions(header: &str) -> Vec<&str> {
    let is_name = |c: char| c.is_ascii_lowercase() || c == '_';
    // Comments stand in lines that begin with a blank; a declaration's first line does not.
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
    fn functions_are_told_from_types_and_comments() {
        let header = "/**\n * See ztl_not(this).\n */\nint ztl_first(int a,\n              int b);\n\
                      typedef void (*ztl_call)(void *context);\nconst char *ztl_second(void);\n";
        assert_eq!(functions(header), ["ztl_first", "ztl_second"]);
    }
}
