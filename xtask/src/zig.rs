//! Requirements of builds for old Linux machines (static programs and shared libraries): zig, with a C++
//! compiler, musl, libc++ and the symbols of every glibc version for each processor; Debian's Rust compiler
//! with the source of `std`; libzmq with CURVE.

use std::env;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use crate::cmd::{Cmd, Outcome};
use crate::curve::{self, Libraries};
use crate::{Dirs, cross};

/// The version of zig. From 0.16 on, its `malloc` aligns to 8 bytes on 32-bit x86, but libzmq needs more.
pub(crate) const ZIG: &str = "0.15.2";

/// The version of `cargo-zigbuild`, which lets cargo use zig.
const ZIGBUILD: &str = "0.24.0";

/// The version of musl in this zig.
pub(crate) const MUSL: &str = "1.2.5";

/// libzmq aligns its commands to 64 bytes for SSE, but allocates aligned queues only with the first flag. It
/// wakes its threads with eventfd (Linux 2.6.27) only with the last two.
const CXX_FLAGS: &str = "-DHAVE_POSIX_MEMALIGN=1 -DZMQ_CACHELINE_SIZE=64 \
    -DZMQ_HAVE_EVENTFD=1 -DZMQ_HAVE_EVENTFD_CLOEXEC=1";

/// The oldest glibc that Rust's library supports: <https://doc.rust-lang.org/rustc/platform-support.html>.
pub(crate) const GLIBC: &str = "2.17";

/// The profile in `Cargo.toml` and `libzmq/Cargo.toml`; both share the crates they compile.
pub(crate) const PROFILE: &str = "dist";

/// A processor that programs are built for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Target {
    /// Its everyday name.
    pub(crate) name: &'static str,
    /// The compiler's target triple.
    pub(crate) triple: &'static str,
    /// zig's target, and the processor.
    pub(crate) zig: &'static str,
    /// The emulator with the weakest supported processor, from Debian's `qemu-user-static`.
    pub(crate) emulator: &'static str,
}

pub(crate) const TARGETS: [Target; 7] = [
    Target {
        name: "x86_64",
        triple: "x86_64-unknown-linux-musl",
        zig: "x86_64-linux-musl",
        emulator: "qemu-x86_64-static -cpu qemu64",
    },
    Target {
        name: "i686",
        triple: "i686-unknown-linux-musl",
        zig: "x86-linux-musl -mcpu=pentium4",
        emulator: "qemu-i386-static -cpu n270",
    },
    Target {
        name: "i586",
        triple: "i586-unknown-linux-musl",
        zig: "x86-linux-musl -mcpu=pentium",
        emulator: "qemu-i386-static -cpu pentium",
    },
    Target {
        name: "aarch64",
        triple: "aarch64-unknown-linux-musl",
        zig: "aarch64-linux-musl",
        emulator: "qemu-aarch64-static -cpu cortex-a53",
    },
    Target {
        name: "armv7",
        triple: "armv7-unknown-linux-musleabihf",
        zig: "arm-linux-musleabihf -mcpu=generic+v7a+vfp3-d32+thumb2-neon",
        emulator: "qemu-arm-static -cpu cortex-a7",
    },
    Target {
        name: "arm",
        triple: "arm-unknown-linux-musleabihf",
        zig: "arm-linux-musleabihf -mcpu=generic+v6+vfp2+strict_align",
        emulator: "qemu-arm-static -cpu arm1176",
    },
    Target {
        name: "armv5te",
        triple: "armv5te-unknown-linux-musleabi",
        zig: "arm-linux-musleabi -mcpu=generic+v5te+soft_float+strict_align",
        emulator: "qemu-arm-static -cpu arm926",
    },
];

impl Target {
    /// The same processor, with glibc instead of musl.
    pub(crate) fn with_glibc(self) -> Self {
        let triple = match self.name {
            "x86_64" => "x86_64-unknown-linux-gnu",
            "i686" => "i686-unknown-linux-gnu",
            "i586" => "i586-unknown-linux-gnu",
            "aarch64" => "aarch64-unknown-linux-gnu",
            "armv7" => "armv7-unknown-linux-gnueabihf",
            "arm" => "arm-unknown-linux-gnueabihf",
            _ => "armv5te-unknown-linux-gnueabi",
        };
        Self { triple, ..self }
    }

    fn has_glibc(&self) -> bool {
        self.triple.contains("-gnu")
    }

    /// The options of zig's compiler for this target.
    pub(crate) fn zig_options(&self) -> String {
        if !self.has_glibc() {
            return format!("-target {}", self.zig);
        }
        let (system, processor) = self.zig.split_once(' ').unwrap_or((self.zig, ""));
        let system = system.replace("musl", "gnu");
        format!("-target {system}.{GLIBC} {processor}")
    }
}

/// The named targets, or all.
pub(crate) fn targets(names: &[&str]) -> Outcome<Vec<Target>> {
    if names.is_empty() {
        return Ok(TARGETS.to_vec());
    }
    let find = |name: &&str| {
        let mut known = TARGETS.into_iter();
        let found = known.find(|target| target.name == *name || target.triple == *name);
        let all = TARGETS.map(|target| target.name).join(", ");
        found.ok_or_else(|| format!("unknown target `{name}`: expected one of {all}"))
    };
    names.iter().map(find).collect()
}

/// The installed tools.
pub(crate) struct Zig {
    /// The programs of the virtual environment.
    programs: PathBuf,
    /// The build directory.
    pub(crate) target_dir: PathBuf,
    flags: Flags,
}

/// Compiler flags that hide the paths of the build machine.
struct Flags {
    rust: String,
    c: String,
}

impl Flags {
    fn of(dirs: &Dirs) -> Self {
        let home = env::var_os("CARGO_HOME").map(PathBuf::from);
        let home = home.or_else(|| Some(PathBuf::from(env::var_os("HOME")?).join(".cargo")));
        let mut places = vec![(dirs.root.clone(), "ztl")];
        places.extend(home.map(|home| (home, "cargo")));
        let mut flags = Self {
            rust: String::new(),
            c: String::new(),
        };
        for (path, name) in places {
            let path = path.display();
            flags.rust += &format!(" --remap-path-prefix={path}={name}");
            flags.c += &format!(" -ffile-prefix-map={path}={name}");
        }
        flags
    }
}

impl Zig {
    /// Finds the tools, and installs missing ones.
    pub(crate) fn provide(dirs: &Dirs) -> Outcome<Self> {
        cross::provide_debian()?;
        let venv = dirs.absolute("zig");
        let programs = venv.join("bin");
        let works = || {
            Cmd::program(programs.join("cargo-zigbuild"))
                .arg("--version")
                .stdout()
        };
        let version = || {
            Cmd::program(programs.join("python"))
                .args("-m ziglang version")
                .stdout()
        };
        let wanted = |(zig, build): (String, String)| zig == ZIG && build.ends_with(ZIGBUILD);
        let there = version().ok().zip(works().ok());
        if !there.is_some_and(wanted) {
            Cmd::new("python3 -m venv --clear").arg(&venv).run()?;
            Cmd::program(programs.join("python"))
                .args("-m pip install --disable-pip-version-check --quiet")
                .arg(format!("ziglang=={ZIG}"))
                .arg(format!("cargo-zigbuild=={ZIGBUILD}"))
                .run()?;
            works()?;
        }
        Ok(Self {
            programs,
            target_dir: dirs.absolute("dist"),
            flags: Flags::of(dirs),
        })
    }

    /// `cargo zigbuild` for a target, without profile and package.
    pub(crate) fn build(&self, target: Target) -> Outcome<Cmd> {
        let mut path = vec![self.programs.clone()];
        path.extend(env::split_paths(&env::var_os("PATH").unwrap_or_default()));
        let path: OsString = env::join_paths(path)
            .map_err(|error| format!("cannot put zig on the PATH: {error}"))?;
        let Flags { rust, c } = &self.flags;
        // With glibc, a shared library is built.
        let (triple, code, pic) = match target.has_glibc() {
            true => (format!("{}.{GLIBC}", target.triple), "pic", " -fPIC"),
            false => (target.triple.to_owned(), "static", ""),
        };
        let rust = format!("-C link-self-contained=no -C relocation-model={code}{rust}");
        let c = format!("{pic}{c}");
        Ok(
            Cmd::new("cargo zigbuild --locked -Zbuild-std=std,panic_unwind --target")
                .arg(triple)
                .arg("--target-dir")
                .arg(&self.target_dir)
                .env("PATH", path)
                .env("RUSTC", cross::DEBIAN_RUSTC)
                // Building `std` is unstable; this enables it in a stable compiler.
                .env("RUSTC_BOOTSTRAP", "1")
                .env("RUSTFLAGS", rust)
                .env("CFLAGS", &c)
                // No program here is position-independent; otherwise zig would build its libc again to try
                // that.
                .env("SODIUM_DISABLE_PIE", "1")
                .env("CXXFLAGS", format!("{CXX_FLAGS}{c}")),
        )
    }

    /// libzmq and libsodium for a target.
    pub(crate) fn libraries(&self, target: Target) -> Outcome<Libraries> {
        curve::libraries(self.build(target)?.args("--profile").arg(PROFILE))
    }

    /// `cargo zigbuild` for a target with the profile, linked with these libraries.
    pub(crate) fn build_with(&self, target: Target, libraries: &Libraries) -> Outcome<Cmd> {
        let build = self.build(target)?.args("--profile").arg(PROFILE);
        Ok(libraries.link(build, target.triple, "c++"))
    }

    /// The path of a program in that profile.
    pub(crate) fn program(&self, target: Target, name: &str) -> PathBuf {
        self.target_dir.join(target.triple).join(PROFILE).join(name)
    }

    /// Python with zig, and these arguments.
    pub(crate) fn command(&self, args: &str) -> Cmd {
        Cmd::program(self.programs.join("python")).args(args)
    }

    /// The directory of zig's sources: musl, libc++, libunwind.
    pub(crate) fn sources(&self) -> Outcome<PathBuf> {
        let find =
            "import os, ziglang; print(os.path.join(os.path.dirname(ziglang.__file__), 'lib'))";
        let path = Cmd::program(self.programs.join("python"))
            .args("-c")
            .arg(find)
            .stdout()?;
        Ok(Path::new(&path).to_path_buf())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_target_with_glibc_is_the_same_processor() {
        let armv7 = targets(&["armv7"]).unwrap()[0];
        let processor = "-mcpu=generic+v7a+vfp3-d32+thumb2-neon";
        let options = armv7.zig_options();
        assert_eq!(options, format!("-target arm-linux-musleabihf {processor}"));
        let options = armv7.with_glibc().zig_options();
        let glibc = format!("-target arm-linux-gnueabihf.2.17 {processor}");
        assert_eq!(options, glibc);
        for target in TARGETS {
            let triple = target.triple.replace("musl", "gnu");
            assert_eq!(target.with_glibc().triple, triple);
        }
    }
}
