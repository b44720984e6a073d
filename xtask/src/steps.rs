//! `cargo xtask check` and `cargo xtask test`: the checks of the project, in the order that fails soonest. Steps
//! that only compute run at the same time as the tests, which mostly wait.

use std::iter;
use std::time::Instant;

use anyhow::{Context as _, Result};
use xshell::cmd;

use crate::beside::Beside;
use crate::cross::Core;
use crate::project::Project;
use crate::zig::Zig;
use crate::{
    bare, capi, cross, deb, dist, firmware, fuzz, image, install, long_runs, package, proof, rerun,
    size,
};

/// The packages outside the workspace.
const APART: [&str; 5] = [
    image::MANIFEST,
    fuzz::MANIFEST,
    firmware::MANIFEST,
    bare::NODE,
    "tests/log-device/Cargo.toml",
];

struct Step {
    name: &'static str,
    about: &'static str,
    run: fn(&Project) -> Result<()>,
}

const fn step(name: &'static str, about: &'static str, run: fn(&Project) -> Result<()>) -> Step {
    Step { name, about, run }
}

const TOOLS: Step = step(
    "tools",
    "all that builds and tests need is installed",
    install_all,
);

#[rustfmt::skip]
const BEFORE: [Step; 10] = [
    step("fmt", "all code is formatted, also outside the workspace", format),
    step("clippy", "no lint fires, in the workspace and in each no_std crate alone", clippy),
    step("doc", "the documentation builds without a warning", doc),
    step("package", "the crates could be published: their packages are complete and compile", package::check),
    step("proof", "bytes from outside reach no panic: shown by linking", proof::prove),
    step("size", "the standard image and the boards' images have the recorded sizes", size::check),
    step("firmware", "the images of examples/firmware build; a Cortex-M0 needs the documented cycles", firmware::check),
    step("test", "all tests: units, documentation examples, and against the original package", tests),
    step("libzmq", "servers and clients pass their tests over libzmq, too", over_libzmq),
    step("c", "the C interface: examples and misuse, with the original's client, under sanitizers and valgrind", capi::test),
];

/// These run beside the ones before: they keep processors busy, no result depends on time, and they build in directories
/// that no step before uses.
#[rustfmt::skip]
const BESIDE: [Step; 5] = [
    step("foreign", "the library and the command type-check for Windows and macOS", package::check_foreign),
    step("bare", "the no_std crates build for three microcontrollers with nothing but `core`", bare::build),
    step("static", "the static programs and C libraries for x86-64 and i686 build", dist::build_tested),
    step("model", "the link keeps its guarantees under every fault, and seeded mistakes are detected", long_runs::check_simulation),
    step("fuzz", "no fuzz target breaks a promise on its corpus, and on inputs generated from one seed", fuzz::smoke),
];

#[rustfmt::skip]
const AFTER: [Step; 3] = [
    step("dist", "the static programs run in an empty root, and on old kernels", dist::check),
    step("deb", "the Debian package installs in an empty root, runs the demo, and leaves no trace", deb::test),
    step("demo", "`ztl demo --once` completes", demo),
];

/// The steps of `cargo xtask check`: before each commit, in a few minutes.
#[rustfmt::skip]
const CHECK: [Step; 4] = [
    step("fmt", "all code is formatted, also outside the workspace", format),
    step("clippy", "no lint fires in the workspace or the fuzz targets", clippy_check),
    step("units", "unit tests", units),
    step("wire", "the codec's recorded cases, and the original package against ours", wire),
];

/// The test binaries of `cargo xtask check`, and their modules that need more than the original package: other peers, or
/// minutes.
const WIRE: [&str; 2] = ["compat", "wire"];
const NOT_IN_CHECK: [&str; 6] = [
    "peers::",
    "protocol::clients::",
    "zmtp::",
    "pickles::",
    "streams::other_implementations",
    "streams::our_subscriber",
];

fn steps() -> impl Iterator<Item = &'static Step> {
    let lists: [&'static [Step]; 4] = [&[TOOLS], &BEFORE, &BESIDE, &AFTER];
    lists.into_iter().flatten()
}

pub(crate) fn names() -> Vec<&'static str> {
    steps().map(|step| step.name).collect()
}

pub(crate) fn list() {
    for step in steps() {
        println!("{:<8} {}", step.name, step.about);
    }
}

/// Runs the named steps one after another, or all.
pub(crate) fn test(project: &Project, only: &[String]) -> Result<()> {
    let begin = Instant::now();
    if only.is_empty() {
        all(project)?;
        println!("\nAll passed in {}", seconds(begin));
        return Ok(());
    }
    for step in steps().filter(|step| only.iter().any(|name| name == step.name)) {
        step.run(project, ONLY)?;
    }
    println!("\nAll passed in {}: {}", seconds(begin), only.join(", "));
    Ok(())
}

const ONLY: &str = "cargo xtask test --only";

fn all(project: &Project) -> Result<()> {
    TOOLS.run(project, ONLY)?;
    let names = BESIDE.each_ref().map(|step| step.name);
    println!(
        "\nBeside the next steps, and shown after them: {}",
        names.join(", ")
    );
    let arguments = names.iter().flat_map(|name| ["--only", name]);
    let mut beside = Beside::start(project, iter::once("test").chain(arguments))?;
    for step in &BEFORE {
        step.run(project, ONLY)?;
        beside.has_not_failed()?;
    }
    beside.end()?;
    AFTER.iter().try_for_each(|step| step.run(project, ONLY))
}

pub(crate) fn check(project: &Project) -> Result<()> {
    let begin = Instant::now();
    for step in &CHECK {
        step.run(project, "cargo xtask check; it stopped at")?;
    }
    println!("\nAll passed in {}", seconds(begin));
    Ok(())
}

impl Step {
    fn run(&self, project: &Project, again: &str) -> Result<()> {
        let Self { name, about, run } = self;
        println!("\n=== {name}: {about}");
        let begin = Instant::now();
        run(project).with_context(|| {
            let time = seconds(begin);
            format!("step `{name}` FAILED after {time}. To run it again: {again} {name}\n")
        })?;
        println!("--- {name}: ok, {}", seconds(begin));
        Ok(())
    }
}

fn seconds(begin: Instant) -> String {
    format!("{:.1} s", begin.elapsed().as_secs_f64())
}

/// Installs everything that builds and tests need, except an empty Debian root, which only root can make.
pub(crate) fn install(project: &Project) -> Result<()> {
    let sh = &project.sh;
    install::programs(project)?;
    install::cargo_deb(project)?;
    install::emulators(sh)?;
    install::javascript(project)?;
    install::peers(project)?;
    install::naoqi(project)?;
    install::zenoh(project)?;
    dist::install_validator(project)?;
    cross::add(sh, &package::FOREIGN);
    let boards = firmware::boards(sh)?;
    let boards = boards.iter().map(|board| board.target.as_str());
    for target in cross::TARGETS.into_iter().chain(boards) {
        Core::provide(sh, target)?;
    }
    Zig::provide(project).map(drop)
}

/// Also makes the Debian root: who may not do that learns it before all other steps, not after them.
fn install_all(project: &Project) -> Result<()> {
    install(project)?;
    install::debian_root(project).map(drop)
}

fn format(project: &Project) -> Result<()> {
    let sh = &project.sh;
    cmd!(sh, "cargo fmt --all --check").run()?;
    for manifest in APART {
        // `--all` means the members of a workspace, but also the dependencies in the main one.
        let all = (manifest == firmware::MANIFEST).then_some("--all");
        cmd!(sh, "cargo fmt {all...} --check --manifest-path {manifest}").run()?;
    }
    Ok(())
}

fn clippy_workspace(project: &Project) -> Result<()> {
    let words = "clippy --workspace --all-targets -- -D warnings";
    Ok(project.cargo(words).run()?)
}

/// A change of a public function that a fuzz target calls is noticed before a commit, too.
fn clippy_check(project: &Project) -> Result<()> {
    clippy_workspace(project)?;
    fuzz::lint(project)
}

/// Crates without some of the features that a build of the workspace turns on.
const PARTLY: [(&str, &[&str]); 3] = [
    ("ztl-zmtp", &["--features", "alloc"]),
    ("ztl-std", &["--no-default-features"]),
    ("ztl", &["--no-default-features", "--features", "small"]),
];

fn clippy(project: &Project) -> Result<()> {
    const DENY: [&str; 3] = ["--", "-D", "warnings"];
    clippy_workspace(project)?;
    let node = project.cargo("clippy --manifest-path").arg(bare::NODE);
    let node = node.arg("--target-dir").arg(project.target.join("node"));
    node.args(DENY).run()?;
    let bare = bare::CRATES.iter();
    let bare = bare.flat_map(|(package, sets)| sets.iter().map(move |set| (*package, *set)));
    for (package, features) in bare.chain(PARTLY) {
        let clippy = project.cargo("clippy --package").arg(package);
        clippy.args(features).args(DENY).run()?;
    }
    Ok(())
}

fn doc(project: &Project) -> Result<()> {
    let doc = project.cargo("doc --workspace --no-deps");
    Ok(doc.env("RUSTDOCFLAGS", "-D warnings").run()?)
}

fn units(project: &Project) -> Result<()> {
    let test = || Ok(project.test_together().args(["--lib", "--bins"]));
    rerun::cargo_test(test, &[])
}

fn wire(project: &Project) -> Result<()> {
    install::python(project)?;
    project.build_programs()?;
    let tests = WIRE.iter().flat_map(|name| ["--test", name]);
    let skip = NOT_IN_CHECK.iter().flat_map(|module| ["--skip", module]);
    let test = || Ok(project.test_together().args(tests.clone()));
    rerun::cargo_test(test, &skip.collect::<Vec<_>>())
}

fn tests(project: &Project) -> Result<()> {
    install::python(project)?;
    install::javascript(project)?;
    install::peers(project)?;
    install::naoqi(project)?;
    install::zenoh(project)?;
    project.build_programs()?;
    firmware::build_for_qemu(project)?;
    // The tests of the simulation run in the step `model`, and those of ztl-c in the step `c`, which builds its
    // libraries.
    rerun::cargo_test(|| Ok(project.test_together()), &[])?;
    // The features that the workspace does not use: components, an async loop, what interrupts share, defmt.
    let tests = ["--package", "ztl-mcu", "--all-features"];
    rerun::cargo_test(|| Ok(project.cargo_test().args(tests)), &[])
}

/// What libzmq lacks: bounds, encryption in the one that `zmq-sys` compiles, and why a connection does not come about.
/// And what uses no connection, or only its own.
const OURS_ALONE: [&str; 14] = [
    "codec::",
    "goals::",
    "pickles::",
    "differential::",
    "bounds::",
    "fuzz::damaged",
    "hostile::a_client_that_never_reads",
    "encrypted::",
    "access::a_client_says",
    "forward::with_keys",
    "parameters::only_clients_that_may",
    "updates::only_clients_that_may",
    "streams::a_key",
    // It does not tell that a connection was lost, so the client waits for its whole timeout.
    "aborts::a_lost_connection",
];

/// The tests of servers and clients, which the step `test` runs over our own connections.
fn over_libzmq(project: &Project) -> Result<()> {
    install::python(project)?;
    install::javascript(project)?;
    install::peers(project)?;
    project.build_programs()?;
    let tests = ["wire", "serve", "gateway", "compat"];
    let tests = tests.iter().flat_map(|name| ["--test", name]);
    let test = || {
        let test = project.test_together().args(tests.clone());
        Ok(test.env("ZTL_TRANSPORT", "libzmq"))
    };
    let skip = OURS_ALONE.iter().flat_map(|module| ["--skip", module]);
    rerun::cargo_test(test, &skip.collect::<Vec<_>>())
}

fn demo(project: &Project) -> Result<()> {
    let sh = &project.sh;
    project.build_programs()?;
    let ztl = project.target.join("debug/ztl");
    // It takes seconds; the limit keeps a hanging demo from stopping the run.
    Ok(cmd!(sh, "timeout 60 {ztl} demo --once --port 0").run()?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use xshell::Shell;

    #[test]
    fn no_workspace_is_left_unformatted() {
        let sh = &Shell::new().unwrap();
        sh.change_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
        let manifests = cmd!(sh, "git ls-files *Cargo.toml").read().unwrap();
        let separate = |path: &&str| sh.read_file(path).unwrap().contains("[workspace]");
        for manifest in manifests.lines().filter(separate) {
            let known = manifest == "Cargo.toml" || APART.contains(&manifest);
            assert!(known, "{manifest}");
        }
    }

    #[test]
    fn each_test_that_is_left_out_over_libzmq_exists() {
        let sh = &Shell::new().unwrap();
        sh.change_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
        for name in OURS_ALONE {
            let (module, test) = name.split_once("::").unwrap();
            let files = cmd!(sh, "git ls-files tests/*/{module}.rs tests/*/{module}/*.rs");
            let files = files.read().unwrap();
            let text = files.lines().map(|file| sh.read_file(file).unwrap());
            assert!(
                text.collect::<String>().contains(&format!("\nfn {test}")),
                "{name}"
            );
        }
    }

    #[test]
    fn each_path_in_the_contributors_guide_exists() {
        paths_exist("CONTRIBUTING.md", "");
    }

    #[test]
    fn each_path_in_the_description_of_the_architecture_exists() {
        paths_exist("ARCHITECTURE.md", "");
    }

    #[test]
    fn each_path_in_the_readme_of_the_tests_exists() {
        paths_exist("tests/README.md", "tests/");
    }

    #[test]
    fn the_readme_of_the_tests_lists_each_binary() {
        let sh = &Shell::new().unwrap();
        sh.change_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../tests"));
        let [manifest, readme] =
            ["Cargo.toml", "README.md"].map(|name| sh.read_file(name).unwrap());
        let names = manifest.split("[[test]]\nname = \"").skip(1);
        let names: Vec<&str> = names.filter_map(|rest| rest.split('"').next()).collect();
        assert!(names.len() > 5, "{names:?}");
        for name in names {
            assert!(readme.contains(&format!("\n| `{name}` | ")), "{name}");
        }
    }

    /// Checks the paths that a document names, from the root or from `base`.
    fn paths_exist(document: &str, base: &str) {
        let sh = &Shell::new().unwrap();
        sh.change_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
        let text = sh.read_file(document).unwrap();
        let words = text.split(['`', '(', ')', '[', ']']);
        let is_path = |word: &&str| {
            !word.contains(' ')
                && word.contains(['/', '.'])
                && !word.starts_with('/')
                && word.len() > 3
        };
        let paths: Vec<&str> = words.filter(is_path).collect();
        assert!(paths.len() > 20, "{paths:?}");
        for path in paths {
            let exists = sh.path_exists(path) || sh.path_exists(format!("{base}{path}"));
            assert!(exists, "{document}: {path}");
        }
    }
}
