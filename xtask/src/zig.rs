//! Requirements of builds for old Linux machines (static programs and shared libraries): zig, with a linker, musl and
//! the symbols of every glibc version for each processor; Debian's Rust compiler with the source of `std`.

use std::env;
use std::path::PathBuf;

use anyhow::{Context as _, Result};
use xshell::{Cmd, cmd};

use crate::project::Project;
use crate::{cross, install};

/// The version of zig.
pub(crate) const ZIG: &str = "0.15.2";

/// `cargo-zigbuild` lets cargo use zig.
const PACKAGES: [&str; 2] = ["ziglang==0.15.2", "cargo-zigbuild==0.24.0"];

/// The version of musl in this zig.
pub(crate) const MUSL: &str = "1.2.5";

/// The oldest glibc that Rust's library supports: <https://doc.rust-lang.org/rustc/platform-support.html>.
pub(crate) const GLIBC: &str = "2.17";

/// The profile in `Cargo.toml`.
pub(crate) const PROFILE: &str = "dist";

/// A processor that programs are built for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Target {
    /// Its everyday name.
    pub(crate) name: &'static str,
    /// With glibc instead of musl.
    pub(crate) glibc: bool,
    triple: &'static str,
    /// zig's target, and the processor.
    zig: &'static str,
    /// The emulator with the weakest supported processor, from Debian's `qemu-user-static`.
    pub(crate) emulator: &'static str,
}

#[rustfmt::skip]
const fn target([name, triple, zig, emulator]: [&'static str; 4]) -> Target {
    Target { name, glibc: false, triple, zig, emulator }
}

#[rustfmt::skip]
const TARGETS: [Target; 7] = [
    target(["x86_64", "x86_64-unknown-linux-musl", "x86_64-linux-musl", "qemu-x86_64-static -cpu qemu64"]),
    target(["i686", "i686-unknown-linux-musl", "x86-linux-musl -mcpu=pentium4", "qemu-i386-static -cpu n270"]),
    target(["i586", "i586-unknown-linux-musl", "x86-linux-musl -mcpu=pentium", "qemu-i386-static -cpu pentium"]),
    target(["aarch64", "aarch64-unknown-linux-musl", "aarch64-linux-musl", "qemu-aarch64-static -cpu cortex-a53"]),
    target(["armv7", "armv7-unknown-linux-musleabihf", "arm-linux-musleabihf -mcpu=generic+v7a+vfp3-d32+thumb2-neon", "qemu-arm-static -cpu cortex-a7"]),
    target(["arm", "arm-unknown-linux-musleabihf", "arm-linux-musleabihf -mcpu=generic+v6+vfp2+strict_align", "qemu-arm-static -cpu arm1176"]),
    target(["armv5te", "armv5te-unknown-linux-musleabi", "arm-linux-musleabi -mcpu=generic+v5te+soft_float+strict_align", "qemu-arm-static -cpu arm926"]),
];

impl Target {
    /// The same processor, with glibc instead of musl.
    pub(crate) fn with_glibc(self) -> Self {
        Self {
            glibc: true,
            ..self
        }
    }

    /// The compiler's target triple.
    pub(crate) fn triple(&self) -> String {
        self.libc(self.triple)
    }

    fn libc(&self, name: &str) -> String {
        name.replace("musl", if self.glibc { "gnu" } else { "musl" })
    }

    /// What follows a target's name: the version of its glibc.
    fn version(&self) -> String {
        let version = || format!(".{GLIBC}");
        self.glibc.then(version).unwrap_or_default()
    }

    /// The options of zig's compiler for this target.
    pub(crate) fn zig_options(&self) -> Vec<String> {
        let mut words = self.zig.split(' ');
        let system = self.libc(words.next().unwrap_or_default()) + &self.version();
        let options = ["-target".to_owned(), system].into_iter();
        options.chain(words.map(str::to_owned)).collect()
    }

    /// Whether it is a processor of small robots.
    pub(crate) fn is_32_bit(&self) -> bool {
        !["x86_64", "aarch64"].contains(&self.name)
    }

    /// Whether this machine has the processor.
    pub(crate) fn is_here(&self) -> bool {
        self.name == env::consts::ARCH
    }
}

/// The named targets, or all.
pub(crate) fn targets<S: AsRef<str>>(names: &[S]) -> Result<Vec<Target>> {
    if names.is_empty() {
        return Ok(TARGETS.to_vec());
    }
    let find = |name: &S| {
        let name = name.as_ref();
        let mut known = TARGETS.into_iter();
        let all = TARGETS.map(|target| target.name).join(", ");
        let wrong = || format!("unknown target `{name}`: expected one of {all}");
        known.find(|target| target.name == name).with_context(wrong)
    };
    names.iter().map(find).collect()
}

/// The installed tools.
pub(crate) struct Zig<'a> {
    project: &'a Project,
    /// The Python environment that contains them.
    python: PathBuf,
    /// The build directory.
    pub(crate) target_dir: PathBuf,
}

impl<'a> Zig<'a> {
    /// Finds the tools, and installs missing ones.
    pub(crate) fn provide(project: &'a Project) -> Result<Self> {
        cross::provide_debian(&project.sh)?;
        Ok(Self {
            project,
            python: install::environment(project, "zig", &PACKAGES, "ziglang")?,
            target_dir: project.target.join("dist"),
        })
    }

    /// `cargo zigbuild` with the profile, for a target, without package.
    pub(crate) fn build(&self, target: Target) -> Result<Cmd<'a>> {
        let Self {
            target_dir,
            python,
            project,
        } = self;
        let sh = &project.sh;
        let path = cross::path_with(&python.with_file_name(""))?;
        // Replaces the paths of the build machine.
        let home =
            env::var("CARGO_HOME").or_else(|_| env::var("HOME").map(|home| home + "/.cargo"))?;
        let places = [
            format!("{}=ztl", project.root.display()),
            format!("{home}=cargo"),
        ];
        let flags = |flag: &str| places.each_ref().map(|place| format!(" {flag}={place}"));
        let flags = |flag: &str| flags(flag).concat();
        // With glibc, a shared library is built.
        let code = if target.glibc { "pic" } else { "static" };
        let triple = target.triple() + &target.version();
        // Without vector instructions: 100 KB less, and old processors have none.
        let serial = "--cfg curve25519_dalek_backend=\"serial\"";
        // On x86 the tables for unwinding are shorter with it: by 160 KB on x86-64.
        let frames = match target.name {
            "x86_64" | "i686" | "i586" => "-C force-frame-pointers=yes",
            _ => "",
        };
        let options =
            format!("-C link-self-contained=no -C relocation-model={code} {serial} {frames}");
        let rust = options + &flags("--remap-path-prefix");
        // Without symbols a backtrace would show only numbers.
        let std = [
            "-Zbuild-std=std,panic_unwind",
            "-Zbuild-std-features=panic-unwind,optimize_for_size",
        ];
        Ok(cmd!(
            sh,
            "cargo zigbuild --locked {std...} --profile {PROFILE} --target {triple}"
        )
        .arg("--target-dir")
        .arg(target_dir)
        .env("PATH", path)
        .env("RUSTC", cross::DEBIAN_RUSTC)
        // Building `std` is unstable; this enables it in a stable compiler.
        .env("RUSTC_BOOTSTRAP", "1")
        .env("RUSTFLAGS", rust))
    }

    /// The path of a built program or library.
    pub(crate) fn built(&self, target: Target, name: &str) -> PathBuf {
        let built = self.target_dir.join(target.triple());
        built.join(PROFILE).join(name)
    }

    /// zig's compiler of C and C++ for a target.
    pub(crate) fn compiler(&self, target: Target) -> Cmd<'a> {
        let (sh, python) = (&self.project.sh, &self.python);
        cmd!(sh, "{python} -m ziglang c++").args(target.zig_options())
    }

    /// The directory of zig's sources: musl, libunwind.
    pub(crate) fn sources(&self) -> Result<PathBuf> {
        let (sh, python) = (&self.project.sh, &self.python);
        let find = "import os, ziglang; print(os.path.dirname(ziglang.__file__) + '/lib')";
        Ok(cmd!(sh, "{python} -c {find}").read()?.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_glibc_target_keeps_its_processor() {
        let armv7 = targets(&["armv7"]).unwrap()[0];
        let processor = "-mcpu=generic+v7a+vfp3-d32+thumb2-neon";
        let options = |libc| ["-target", libc, processor];
        assert_eq!(armv7.zig_options(), options("arm-linux-musleabihf"));
        let armv7 = armv7.with_glibc();
        assert_eq!(armv7.zig_options(), options("arm-linux-gnueabihf.2.17"));
        assert_eq!(armv7.triple(), "armv7-unknown-linux-gnueabihf");
        let error = targets(&["armv8"]).unwrap_err().to_string();
        assert!(error.contains("aarch64"), "{error}");
    }
}
