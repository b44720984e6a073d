//! Installs what builds and tests need: Debian packages, Python environments, an npm package, old peers.

use std::env;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use xshell::{Cmd, Shell, cmd};

use crate::project::{Project, succeeds};

/// Debian packages, and the shell command that fails without them. The first line of its output is their version.
#[rustfmt::skip]
const PROGRAMS: &[[&str; 2]] = &[
    ["g++", "${CXX:-c++} --version"],
    // For libsodium.
    ["make", "make --version"],
    // On Debian, `ensurepip`, which installs pip into a new environment, is a separate package.
    ["python3 python3-venv", "python3 -c 'import ensurepip, sys, venv; print(\"Python\", sys.version)'"],
    // For the client in C.
    ["gcc libc6-dev libzmq3-dev", "printf '#include <zmq.h>\nlibzmq ZMQ_VERSION_MAJOR ZMQ_VERSION_MINOR' | cc -E -P - | grep '^libzmq [0-9]'"],
    ["valgrind", "valgrind --version"],
    ["pkg-config", "pkg-config --version"],
    ["gcc-arm-none-eabi", "arm-none-eabi-gcc --version"],
    // For the client in JavaScript.
    ["nodejs", "node --eval 'console.log(\"Node\", process.version)'"],
    ["npm", "echo npm $(npm --version) | grep '[0-9]'"],
    // Makes a tone for a stream.
    ["sox", "sox --version"],
    // Shows the pages of `ztl report` and `ztl web`.
    ["chromium", "chromium --version"],
    // Makes a certificate for `ztl web --tls`.
    ["openssl", "openssl version"],
    // Shells that complete our command.
    ["zsh", "zsh --version"],
    ["fish", "fish --version"],
    // `setsid` gives a program a terminal of its own.
    ["util-linux", "setsid --version"],
    // `systemd-analyze` checks the units in examples.
    ["systemd", "systemd-analyze --version"],
    // A robot of ROS 1: a master, nodes and action servers. Another Python on the PATH does not find them.
    [
        "python3-rosmaster python3-rospy python3-actionlib python3-rosgraph-msgs python3-std-srvs python3-geometry-msgs \
         python3-sensor-msgs python3-trajectory-msgs libactionlib-dev ros-actionlib-msgs ros-geometry-msgs ros-nav-msgs \
         ros-move-base-msgs ros-roscpp-msg ros-rosgraph-msgs ros-sensor-msgs ros-std-msgs ros-std-srvs ros-trajectory-msgs",
        "cd /usr/share/actionlib && cd /usr/share/move_base_msgs && cd /usr/share/roscpp && cd /usr/share/nav_msgs && \
         /usr/bin/python3 -c 'import actionlib, geometry_msgs, rosgraph_msgs, rosmaster, rospy, sensor_msgs, std_srvs, trajectory_msgs; print(\"rospy\", rospy.__file__)'",
    ],
    // Make the Debian package, and a root to install it in.
    ["xz-utils", "xz --version"],
    ["debootstrap", "debootstrap --version"],
    ["rustfmt-web", "cargo fmt --version"],
    ["rust-web-clippy", "cargo clippy --version"],
    QEMU,
];

/// Runs the firmware.
const QEMU: [&str; 2] = [
    "qemu-system-arm qemu-system-misc",
    "qemu-system-riscv32 --version >&2 && qemu-system-arm --version",
];

/// Installs all missing programs.
pub(crate) fn programs(project: &Project) -> Result<()> {
    let sh = &project.sh;
    let lacks = |check: &str| version(sh, check).is_err();
    if has(sh, "rustup") && (lacks("cargo fmt --version") || lacks("cargo clippy --version")) {
        cmd!(sh, "rustup component add rustfmt clippy").run()?;
    }
    let lacking = PROGRAMS.iter().filter(|[_, check]| lacks(check));
    let lacking: Vec<&str> = lacking.map(|[packages, _]| *packages).collect();
    if !lacking.is_empty() {
        install(sh, &lacking.join(" "))?;
    }
    for [packages, check] in PROGRAMS {
        // May still fail: another program of that name may come first on the PATH.
        let version = version(sh, check).with_context(|| format!("{packages} is missing"))?;
        println!("found: {version}");
    }
    Ok(())
}

fn version(sh: &Shell, check: &str) -> Result<String> {
    let text = cmd!(sh, "sh -c {check}").ignore_stderr().read()?;
    Ok(text.lines().next().context("it prints nothing")?.to_owned())
}

/// Whether the program can be started.
pub(crate) fn has(sh: &Shell, program: &str) -> bool {
    succeeds(cmd!(sh, "{program} --version"))
}

/// Installs Debian packages; without the permission, says what to install.
pub(crate) fn install(sh: &Shell, packages: &str) -> Result<()> {
    let install = "apt-get install -y --no-install-recommends";
    if cmd!(sh, "id -u").read()? != "0" || !has(sh, "apt-get") {
        bail!("packages are missing: run `sudo apt-get update && sudo {install} {packages}`");
    }
    let words = install.split(' ').chain(packages.split(' '));
    cmd!(sh, "apt-get update").run()?;
    cmd!(sh, "env DEBIAN_FRONTEND=noninteractive {words...}").run()?;
    Ok(())
}

/// Installs QEMU for the boards if missing.
pub(crate) fn qemu(sh: &Shell) -> Result<()> {
    let [packages, check] = QEMU;
    version(sh, check).map_or_else(|_| install(sh, packages), |_| Ok(()))
}

/// Installs actionlib for C++ if missing.
pub(crate) fn actionlib(sh: &Shell) -> Result<()> {
    let there = "pkg-config --exists actionlib";
    match succeeds(cmd!(sh, "sh -c {there}")) {
        true => Ok(()),
        false => install(sh, "libactionlib-dev"),
    }
}

/// Installs emulators for other processors if missing.
pub(crate) fn emulators(sh: &Shell) -> Result<()> {
    match has(sh, "qemu-i386-static") {
        true => Ok(()),
        false => install(sh, "qemu-user-static"),
    }
}

/// Installs cargo-deb below the target directory; returns the program.
pub(crate) fn cargo_deb(project: &Project) -> Result<PathBuf> {
    const PACKAGE: &str = "cargo-deb@3.8.0";
    let sh = &project.sh;
    let home = project.target.join("tools");
    let program = home.join("bin/cargo-deb");
    let works = || has(sh, &program.to_string_lossy());
    make_once(sh, &home.join("deb.stamp"), PACKAGE, works, || {
        // Without its feature `lzma` it runs `xz`.
        // Compiled without optimisation, it packs one program as well.
        let options = ["--locked", "--debug", "--no-default-features", "--root"];
        cmd!(sh, "cargo install {options...} {home} {PACKAGE}").run()
    })?;
    Ok(program)
}

/// A minimal Debian 12; nothing is ever installed in it.
pub(crate) fn debian_root(project: &Project) -> Result<PathBuf> {
    const SUITE: &str = "bookworm";
    let sh = &project.sh;
    if cmd!(sh, "id -u").read()? != "0" {
        bail!("only root may make a Debian root: run the test command as root");
    }
    let root = project.target.join("debian").join(SUITE);
    let works = || root.join("usr/sbin/adduser").exists();
    let stamp = root.with_extension("stamp");
    make_once(sh, &stamp, SUITE, works, || {
        sh.remove_path(&root)?;
        let options = ["--variant=minbase", "--include=adduser"];
        cmd!(sh, "debootstrap {options...} {SUITE} {root}").run()
    })?;
    Ok(root)
}

/// Runs `make`, unless the stamp says that it was run for the same content, and the result works.
fn make_once(
    sh: &Shell,
    stamp: &Path,
    content: &str,
    works: impl Fn() -> bool,
    make: impl FnOnce() -> xshell::Result<()>,
) -> Result<()> {
    let made = stamp.exists() && sh.read_file(stamp)? == content;
    if made && works() {
        println!("{} is up to date", stamp.display());
        return Ok(());
    }
    sh.remove_path(stamp)?;
    make()?;
    ensure!(
        works(),
        "the new installation does not work: see {}",
        stamp.display()
    );
    // Written last: without it, the installation is incomplete.
    Ok(sh.write_file(stamp, content)?)
}

/// pip of this Python, with these words.
fn pip<'a>(sh: &'a Shell, python: &Path, words: &str) -> Cmd<'a> {
    let pip = cmd!(sh, "{python} -m pip --disable-pip-version-check");
    pip.args(words.split(' '))
}

/// A Python environment below the target directory with exactly these packages and what they need; returns its
/// Python.
pub(crate) fn environment(
    project: &Project,
    name: &str,
    packages: &[&str],
    import: &str,
) -> Result<PathBuf> {
    let sh = &project.sh;
    let venv = project.target.join(name);
    let python = venv.join("bin/python");
    let import = format!("import {import}");
    let works = || succeeds(cmd!(sh, "{python} -c {import}"));
    let (stamp, content) = (venv.join("made.stamp"), packages.join(" "));
    make_once(sh, &stamp, &content, works, || {
        cmd!(sh, "python3 -m venv --clear {venv}").run()?;
        pip(sh, &python, "install --quiet").args(packages).run()
    })?;
    Ok(python)
}

/// Installs libqi, the messaging library of NAOqi, as a Python package, unless `ZTL_NAOQI` names a Python that has it.
pub(crate) fn naoqi(project: &Project) -> Result<()> {
    const PACKAGE: &str = "qi==3.1.5";
    if let Some(python) = env::var_os("ZTL_NAOQI") {
        let import = ["-c", "import qi"];
        return Ok(cmd!(project.sh, "{python} {import...}").run()?);
    }
    let installed = environment(project, "naoqi", &[PACKAGE], "qi");
    installed.map(drop).with_context(|| {
        format!(
            "PyPI has {PACKAGE} for Python 3.7 to 3.12 on x86-64. Debian 11 and 12 have such a Python, Debian 13 has not: \
             there, install one, and name it in ZTL_NAOQI once it has the package"
        )
    })
}

/// Installs Zenoh as a Python package, unless `ZTL_ZENOH` names a Python that has it.
pub(crate) fn zenoh(project: &Project) -> Result<()> {
    if let Some(python) = env::var_os("ZTL_ZENOH") {
        let import = ["-c", "import zenoh"];
        return Ok(cmd!(project.sh, "{python} {import...}").run()?);
    }
    environment(project, "zenoh", &["eclipse-zenoh==1.10.2"], "zenoh").map(drop)
}

/// Installs the original ZTL package, with every package in the listed version, and its own tests, which only the
/// source archive has. Returns its Python.
pub(crate) fn python(project: &Project) -> Result<PathBuf> {
    const PACKAGES: &str = "tests/requirements.txt";
    const SUITE: &str = "tests/compat/original_suite/requirements.txt";
    let sh = &project.sh;
    let content = sh.read_file(PACKAGES)? + &sh.read_file(SUITE)?;
    let venv = project.target.join("venv");
    let python = venv.join("bin/python");
    let suite = venv.join("original");
    // Also runs it: an environment breaks when its base Python is removed.
    let works = || {
        succeeds(cmd!(
            sh,
            "{python} -c 'import ztl, zmq, oyaml, pytest, numpy, roslibpy, mcap.reader, jsonschema'"
        ))
    };
    let stamp = venv.join("requirements.stamp");
    make_once(sh, &stamp, &content, works, || {
        let archive = suite.join("ztl-0.3.3.tar.gz");
        let download = "download --no-deps --no-binary ztl --requirement";
        cmd!(sh, "python3 -m venv --clear {venv}").run()?;
        pip(sh, &python, "install --no-deps --requirement")
            .arg(PACKAGES)
            .run()?;
        pip(sh, &python, download)
            .args([SUITE, "--dest"])
            .arg(&suite)
            .run()?;
        cmd!(sh, "{python} -m tarfile --extract {archive} {suite}").run()
    })?;
    Ok(python)
}

/// Installs npm packages: of `examples/clients/client.mjs`, of Foxglove's reader of recordings, what drives and examines the
/// page of `ztl web` and reads its QR codes, and a rosbridge client.
pub(crate) fn javascript(project: &Project) -> Result<()> {
    const PACKAGES: [&str; 8] = [
        "zeromq@6.8.0",
        "roslib@2.1.0",
        "axe-core@4.14.1",
        "playwright-core@1.65.1",
        "@mcap/core@2.2.2",
        "@foxglove/schemas@2.1.0",
        "ajv@8.20.0",
        "jsqr@1.4.0",
    ];
    let sh = &project.sh;
    let home = project.target.join("clients");
    let packages = [
        "zeromq",
        "@mcap/core",
        "@foxglove/schemas/jsonschema",
        "ajv",
    ];
    let packages = packages.map(|name| home.join("node_modules").join(name));
    let load = "process.argv.slice(1).forEach(require)";
    // Also loads the packages: one breaks after an update of Node.
    let works = || succeeds(cmd!(sh, "node --eval {load}").args(&packages));
    let content = PACKAGES.join(" ");
    make_once(sh, &home.join("package.stamp"), &content, works, || {
        // One package contains a compiled library; its script would only rebuild it.
        cmd!(
            sh,
            "npm install --ignore-scripts --no-save --no-audit --no-fund --prefix {home} {PACKAGES...}"
        )
        .run()
    })
}

/// Installs the dependencies of the peers in `tests/peers`: an old libzmq, JeroMQ, and the original under Python 2.7
/// if the machine has that.
pub(crate) fn peers(project: &Project) -> Result<()> {
    let sh = &project.sh;
    let home = project.target.join("peers");
    old_libzmq(sh, &python(project)?, &home)?;
    java(sh, &home)?;
    match python27(sh) {
        Some(python27) => original27(sh, &python27, &home),
        None => {
            println!("SKIPPED: the original under Python 2.7, which this machine does not have");
            Ok(())
        }
    }
}

/// Extracts libzmq 4.1.6 from a package for Python 2.7.
fn old_libzmq(sh: &Shell, python: &Path, home: &Path) -> Result<()> {
    const WHEEL: &str = "pyzmq==16.0.4";
    let wheels = home.join("wheels");
    let library = home.join("libzmq-4.1.6.so");
    let extract = "import glob, shutil, sys, zipfile; \
        zipfile.ZipFile(glob.glob(sys.argv[1] + '/pyzmq-*')[0]).extractall(sys.argv[1]); \
        shutil.copy(glob.glob(sys.argv[1] + '/zmq/.libs/libzmq-*')[0], sys.argv[2])";
    let works = || library.exists();
    make_once(sh, &home.join("libzmq-4.1.6.stamp"), WHEEL, works, || {
        let words = "download --no-deps --only-binary=:all: --python-version 27 --implementation cp \
            --abi cp27mu --platform manylinux1_x86_64 --dest";
        pip(sh, python, words).arg(&wheels).arg(WHEEL).run()?;
        cmd!(sh, "{python} -c {extract} {wheels} {library}").run()
    })
}

/// Compiles the program that uses JeroMQ.
fn java(sh: &Shell, home: &Path) -> Result<()> {
    const SOURCE: &str = "tests/peers/Peer.java";
    const JEROMQ: &str = "/usr/share/java/jeromq.jar";
    let runs = |name: &&str| succeeds(cmd!(sh, "{name} -version"));
    let compiler = || ["javac", "ecj"].into_iter().find(runs);
    if !Path::new(JEROMQ).exists() || !runs(&"java") || compiler().is_none() {
        // ecj needs no JDK, which is three times as large.
        install(sh, "default-jre-headless ecj libjeromq-java")?;
    }
    let compiler = compiler().context("no Java compiler found")?;
    let classes = home.join("java");
    let works = || classes.exists();
    let (stamp, source) = (home.join("java.stamp"), sh.read_file(SOURCE)?);
    make_once(sh, &stamp, &source, works, || {
        let options = "-source 11 -target 11 -nowarn -cp".split(' ');
        cmd!(sh, "{compiler} {options...} {JEROMQ} -d {classes} {SOURCE}").run()
    })
}

/// Installs the original and its dependencies for Python 2.7.
fn original27(sh: &Shell, python27: &Path, home: &Path) -> Result<()> {
    const PACKAGES: &str = "tests/peers/python27.txt";
    let packages = home.join("python27");
    let link = packages.join("python2.7");
    let works = || link.exists();
    let (stamp, content) = (home.join("python27.stamp"), sh.read_file(PACKAGES)?);
    make_once(sh, &stamp, &content, works, || {
        sh.remove_path(&packages)?;
        let words = "install --no-deps --no-binary ztl --requirement";
        let install = pip(sh, python27, words).args([PACKAGES, "--target"]);
        install.arg(&packages).run()?;
        cmd!(sh, "ln -s {python27} {link}").run()
    })
}

/// A Python 2.7 with pip: the one on the PATH, or one from pyenv.
fn python27(sh: &Shell) -> Option<PathBuf> {
    let root = cmd!(sh, "pyenv root").quiet().ignore_stderr().read();
    let root = root.ok().or_else(|| env::var("PYENV_ROOT").ok());
    let versions = root.and_then(|root| sh.read_dir(Path::new(&root).join("versions")).ok());
    let versions = versions.unwrap_or_default().into_iter();
    let candidates = versions.map(|version| version.join("bin/python2.7"));
    let mut candidates = std::iter::once(PathBuf::from("python2.7")).chain(candidates);
    candidates.find_map(|python| {
        let found = cmd!(sh, "{python} -c 'import pip, sys; print(sys.executable)'");
        found.ignore_stderr().read().ok().map(PathBuf::from)
    })
}
