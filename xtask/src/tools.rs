//! Checks and installs the programs that the other steps need.

use std::env;

use crate::cmd::{Cmd, Outcome};

/// A required program.
struct Need {
    what: &'static str,
    /// Succeeds if the program is present; the first line of output is its version.
    check: fn() -> Cmd,
    /// The rustup component that contains it, if any.
    component: Option<&'static str>,
    /// The Debian packages that contain it.
    packages: &'static [&'static str],
}

const NEEDS: &[Need] = &[
    Need {
        what: "a C++ compiler (`c++`, or the one that CXX names), for libzmq",
        check: || Cmd::new(env::var("CXX").as_deref().unwrap_or("c++")).arg("--version"),
        component: None,
        packages: &["g++"],
    },
    Need {
        what: "`make`, for libsodium",
        check: || Cmd::new("make --version"),
        component: None,
        packages: &["make"],
    },
    Need {
        what: "`python3` with venv and pip, for the original ZTL package",
        // On Debian, `ensurepip`, which installs pip into a new venv, is a separate package.
        check: || {
            Cmd::new("python3 -c").arg("import ensurepip, sys, venv; print('Python', sys.version)")
        },
        component: None,
        packages: &["python3", "python3-venv"],
    },
    Need {
        what: "`cc` and libzmq for C, for the client in C",
        check: || {
            let version = "echo libzmq ZMQ_VERSION_MAJOR ZMQ_VERSION_MINOR ZMQ_VERSION_PATCH";
            let read = "cc -E -P -include zmq.h - | grep '^libzmq [0-9]'";
            Cmd::new("sh -c").arg(format!("{version} | {read}"))
        },
        component: None,
        packages: &["gcc", "libc6-dev", "libzmq3-dev"],
    },
    Need {
        what: "`valgrind` and `pkg-config`, for the tests in C",
        check: || Cmd::new("sh -c").arg("pkg-config --version >&2 && valgrind --version"),
        component: None,
        packages: &["valgrind", "pkg-config"],
    },
    Need {
        what: "`arm-none-eabi-gcc`, for firmware in C",
        check: || Cmd::new("arm-none-eabi-gcc --version"),
        component: None,
        packages: &["gcc-arm-none-eabi"],
    },
    Need {
        what: "`node`, for the client in JavaScript",
        check: || Cmd::new("node --eval").arg("console.log('Node', process.version)"),
        component: None,
        packages: &["nodejs"],
    },
    Need {
        what: "`npm`, for its package",
        check: || Cmd::new("sh -c").arg("echo npm $(npm --version) | grep '[0-9]'"),
        component: None,
        packages: &["npm"],
    },
    Need {
        what: "`chromium`, which shows the page of `ztl report`",
        check: || Cmd::new("chromium --version"),
        component: None,
        packages: &["chromium"],
    },
    Need {
        what: "`setsid`, which gives a program a terminal of its own",
        check: || Cmd::new("setsid --version"),
        component: None,
        packages: &["util-linux"],
    },
    Need {
        what: "`systemd-analyze`, for the units in examples",
        check: || Cmd::new("systemd-analyze --version"),
        component: None,
        packages: &["systemd"],
    },
    Need {
        what: "`cargo fmt`",
        check: || Cmd::new("cargo fmt --version"),
        component: Some("rustfmt"),
        packages: &["rustfmt-web"],
    },
    Need {
        what: "`cargo clippy`",
        check: || Cmd::new("cargo clippy --version"),
        component: Some("clippy"),
        packages: &["rust-web-clippy"],
    },
    QEMU,
];

/// Runs the firmware.
const QEMU: Need = Need {
    what: "QEMU for ARM and RISC-V, which runs the firmware",
    check: || {
        Cmd::new("sh -c").arg("qemu-system-riscv32 --version >&2 && qemu-system-arm --version")
    },
    component: None,
    packages: &["qemu-system-arm", "qemu-system-misc"],
};

/// Installs QEMU for the boards if missing.
pub(crate) fn provide_qemu() -> Outcome {
    match QEMU.version() {
        Ok(_) => Ok(()),
        Err(_) => install(QEMU.packages),
    }
}

/// Installs emulators for other processors if missing.
pub(crate) fn provide_emulators() -> Outcome {
    if has("qemu-i386-static") {
        return Ok(());
    }
    install(&["qemu-user-static"])
}

/// Installs all missing programs.
pub(crate) fn check() -> Outcome {
    let mut packages = Vec::new();
    for need in NEEDS.iter().filter(|need| need.version().is_err()) {
        println!("lacking: {}", need.what);
        match need.component {
            Some(component) if has("rustup") => {
                Cmd::new("rustup component add").arg(component).run()?;
            }
            _ => packages.extend(need.packages),
        }
    }
    if !packages.is_empty() {
        install(&packages)?;
    }
    for need in NEEDS {
        // May still fail: another program of that name may come first on the PATH.
        let version = need
            .version()
            .map_err(|error| format!("still missing: {}: {error}", need.what))?;
        println!("found: {version}");
    }
    Ok(())
}

impl Need {
    fn version(&self) -> Outcome<String> {
        let text = (self.check)().stdout()?;
        Ok(text.lines().next().unwrap_or_default().to_owned())
    }
}

/// Whether the program can be started.
pub(crate) fn has(program: &str) -> bool {
    Cmd::new(program).arg("--version").stdout().is_ok()
}

/// Installs Debian packages; without the permission, says what to install.
pub(crate) fn install(packages: &[&str]) -> Outcome {
    let install = format!(
        "apt-get install -y --no-install-recommends {}",
        packages.join(" ")
    );
    let root = Cmd::new("id -u").stdout()? == "0";
    if !root || !has("apt-get") {
        return Err(format!(
            "packages are lacking. To install them on Debian:\n    \
             sudo apt-get update && sudo {install}"
        ));
    }
    Cmd::new("apt-get update").run()?;
    Cmd::new(&install)
        .env("DEBIAN_FRONTEND", "noninteractive")
        .run()
}
