//! Installs the dependencies of the peers in `tests/peers`: an old libzmq, Python 2.7 if the machine has it,
//! JeroMQ.

use std::env;
use std::fs;
use std::path::{Path, PathBuf};

use crate::cmd::{Cmd, Outcome};
use crate::{Dirs, python, tools};

const PYTHON27: &str = "tests/peers/python27.txt";
const JAVA: &str = "tests/peers/Peer.java";

/// JeroMQ from Debian.
const JEROMQ: &str = "/usr/share/java/jeromq.jar";

/// Its Linux package for Python 2.7 contains libzmq 4.1.6.
const WHEEL: &str = "pyzmq==16.0.4";

/// Installs what is missing; returns the directory.
pub(crate) fn ensure(dirs: &Dirs) -> Outcome<PathBuf> {
    let home = dirs.target.join("peers");
    fs::create_dir_all(&home)
        .map_err(|error| format!("cannot make {}: {error}", home.display()))?;
    let python = python::ensure(dirs)?;
    step(&home, "libzmq-4.1.6", WHEEL, || old_libzmq(&python, &home))?;
    step(&home, "java", &read(JAVA)?, || java(&home))?;
    match python27() {
        Some(python27) => step(&home, "python27", &read(PYTHON27)?, || {
            original(&python27, &home)
        })?,
        None => {
            println!("skipped: the original under Python 2.7, which this machine does not have")
        }
    }
    // Absolute, because Cargo runs each test in its package's directory.
    Ok(dirs.absolute("peers"))
}

fn read(file: &str) -> Outcome<String> {
    fs::read_to_string(file).map_err(|error| format!("cannot read {file}: {error}"))
}

/// Runs `make` to create `name`, unless it was already made from the same input.
fn step(home: &Path, name: &str, of: &str, make: impl FnOnce() -> Outcome) -> Outcome {
    let stamp = home.join(format!("{name}.stamp"));
    if fs::read_to_string(&stamp).is_ok_and(|made| made == of) {
        println!("{} has {name}", home.display());
        return Ok(());
    }
    make()?;
    // Written last: without it, the step is incomplete.
    fs::write(&stamp, of).map_err(|error| format!("cannot write {}: {error}", stamp.display()))
}

/// Extracts libzmq from a package for Python 2.7.
fn old_libzmq(python: &Path, home: &Path) -> Outcome {
    let wheels = home.join("wheels");
    Cmd::program(python)
        .args("-m pip download --disable-pip-version-check --no-deps --only-binary=:all:")
        .args("--python-version 27 --implementation cp --abi cp27mu --platform manylinux1_x86_64")
        .arg("--dest")
        .arg(&wheels)
        .arg(WHEEL)
        .run()?;
    let entries = |directory: &Path, begin: &str| -> Outcome<PathBuf> {
        let list = fs::read_dir(directory)
            .map_err(|error| format!("cannot read {}: {error}", directory.display()))?;
        let mut paths = list.flatten().map(|entry| entry.path());
        let name = |path: &PathBuf| {
            path.file_name()
                .map(|name| name.to_string_lossy().into_owned())
        };
        paths
            .find(|path| name(path).is_some_and(|name| name.starts_with(begin)))
            .ok_or_else(|| format!("no {begin}… in {}", directory.display()))
    };
    Cmd::program(python)
        .args("-m zipfile --extract")
        .arg(entries(&wheels, "pyzmq-")?)
        .arg(&wheels)
        .run()?;
    let library = entries(&wheels.join("zmq/.libs"), "libzmq-")?;
    let to = home.join("libzmq-4.1.6.so");
    fs::copy(&library, &to)
        .map(drop)
        .map_err(|error| format!("cannot write {}: {error}", to.display()))
}

/// Compiles the program that uses JeroMQ.
fn java(home: &Path) -> Outcome {
    let compiler = || ["javac", "ecj"].into_iter().find(|name| runs(name));
    if !Path::new(JEROMQ).exists() || !runs("java") || compiler().is_none() {
        // ecj needs no JDK, which is three times as large.
        tools::install(&["default-jre-headless", "ecj", "libjeromq-java"])?;
    }
    let compiler = compiler().ok_or("no Java compiler found, even after installing one")?;
    Cmd::new(compiler)
        .args("-source 11 -target 11 -nowarn -cp")
        .arg(JEROMQ)
        .arg("-d")
        .arg(home.join("java"))
        .arg(JAVA)
        .run()
}

fn runs(program: &str) -> bool {
    Cmd::new(program).arg("-version").stdout().is_ok()
}

/// Installs the original and its dependencies for Python 2.7.
fn original(python27: &Path, home: &Path) -> Outcome {
    let packages = home.join("python27");
    if packages.exists() {
        fs::remove_dir_all(&packages)
            .map_err(|error| format!("cannot remove {}: {error}", packages.display()))?;
    }
    Cmd::program(python27)
        .args("-m pip install --disable-pip-version-check --no-deps --no-binary ztl --target")
        .arg(&packages)
        .arg("--requirement")
        .arg(PYTHON27)
        .run()?;
    let link = packages.join("python2.7");
    std::os::unix::fs::symlink(python27, &link)
        .map_err(|error| format!("cannot make {}: {error}", link.display()))
}

/// A Python 2.7 with pip: the one on the PATH, or one from pyenv.
fn python27() -> Option<PathBuf> {
    let mut candidates = vec![PathBuf::from("python2.7")];
    let root = Cmd::new("pyenv root").stdout().ok().map(PathBuf::from);
    let root = root.or_else(|| env::var_os("PYENV_ROOT").map(PathBuf::from));
    if let Some(versions) = root.and_then(|root| fs::read_dir(root.join("versions")).ok()) {
        candidates.extend(
            versions
                .flatten()
                .map(|entry| entry.path().join("bin/python2.7")),
        );
    }
    candidates.into_iter().find_map(|python| {
        let found = Cmd::program(&python)
            .args("-c")
            .arg("import pip, sys; print(sys.executable)");
        found.stdout().ok().map(PathBuf::from)
    })
}
