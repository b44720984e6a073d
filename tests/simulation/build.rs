//! Copies the sources of both ends, with switches for the mutations in `src/mutants.rs`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::{env, fs, io};

#[path = "src/mutants.rs"]
mod mutants;

#[path = "src/fleet_mutants.rs"]
mod fleet_mutants;

use fleet_mutants::FLEET;
use mutants::{MUTANTS, Mutant};

/// Module path of the copy.
const ENDS: &str = "crate::broken::ends";

fn main() -> io::Result<()> {
    let root = Path::new("../..");
    let out = PathBuf::from(env::var_os("OUT_DIR").unwrap_or_default());
    println!("cargo::rerun-if-changed=build.rs");
    // Without optimisation the long tests are left out.
    println!("cargo::rustc-check-cfg=cfg(optimised)");
    if env::var("OPT_LEVEL").is_ok_and(|level| level != "0") {
        println!("cargo::rustc-cfg=optimised");
    }
    println!("cargo::rerun-if-changed=src/mutants.rs");
    println!("cargo::rerun-if-changed=src/fleet_mutants.rs");

    let mut files = BTreeMap::new();
    let mcu = root.join("ztl-mcu/src");
    let names = [
        "acting.rs",
        "bus.rs",
        "component",
        "component.rs",
        "describe.rs",
        "log.rs",
        "log",
        "node.rs",
        "node",
        "parameters",
        "update.rs",
        "update",
    ];
    for name in names {
        collect(&mcu.join(name), &mut files)?;
    }
    collect(&root.join("ztl-link/src"), &mut files)?;
    for name in ["agent.rs", "agent", "endpoint.rs", "endpoint", "wire.rs"] {
        collect(&root.join("ztl-fleet/src").join(name), &mut files)?;
    }

    let mut lost = Vec::new();
    for (number, mutant) in all().enumerate() {
        let _ = (mutant.name, mutant.caught_in, mutant.complaint);
        for (file, _, _) in mutant.edits {
            if !files.contains_key(&root.join(file)) {
                lost.push(number);
            }
        }
    }
    for (path, text) in &mut files {
        lost.extend(break_it(root, path, text));
    }

    for (path, text) in &files {
        let place = path.strip_prefix(root).unwrap_or(path);
        let target = out.join(place);
        fs::create_dir_all(target.parent().unwrap_or(&out))?;
        fs::write(&target, text)?;
    }
    let modules = format!(
        "#[path = {:?}]\n/// The node.\npub mod mcu {{\n\
         mod acting;\npub mod bus;\nmod component;\npub mod describe;\npub mod log;\nmod node;\npub mod parameters;\npub mod update;\n\
         pub use acting::{{Acting, OwnWork}};\n\
         pub use component::{{Component, Components, Reading, Refused, Report, Run}};\n\
         pub use node::{{Counters, Identity, LinkUp, Node, Reason}};\n}}\n\
         #[path = {:?}]\n/// The gateway's end.\npub mod link;\n\
         #[path = {:?}]\n/// The rules of a fleet.\npub mod fleet {{\npub mod agent;\npub mod endpoint;\npub mod wire;\n}}\n\
         /// Mutants whose code is not found.\npub(crate) const LOST: &[usize] = &{lost:?};\n",
        out.join("ztl-mcu/src"),
        out.join("ztl-link/src/lib.rs"),
        out.join("ztl-fleet/src"),
    );
    fs::write(out.join("ends.rs"), modules)
}

fn all() -> impl Iterator<Item = &'static Mutant> {
    MUTANTS.iter().chain(FLEET)
}

/// Reads a file, or all files of a directory, without their tests.
fn collect(path: &Path, files: &mut BTreeMap<PathBuf, String>) -> io::Result<()> {
    println!("cargo::rerun-if-changed={}", path.display());
    if path.file_stem().is_some_and(|name| name == "tests") {
        return Ok(());
    }
    if path.is_dir() {
        for entry in fs::read_dir(path)? {
            collect(&entry?.path(), files)?;
        }
        return Ok(());
    }
    if !path.exists() {
        return Ok(());
    }
    let text = fs::read_to_string(path)?;
    // The tests are at the end.
    let text = text
        .split("#[cfg(test)]\nmod tests")
        .next()
        .unwrap_or_default();
    files.insert(path.to_owned(), text.to_owned());
    Ok(())
}

/// Adds the switches to a file. Returns the mutants whose code is not found.
fn break_it(root: &Path, path: &Path, text: &mut String) -> Vec<usize> {
    // Each piece of code once, with the mutants that change it.
    let mut places: BTreeMap<&str, (&str, Vec<usize>)> = BTreeMap::new();
    for (number, mutant) in all().enumerate() {
        let here = mutant
            .edits
            .iter()
            .filter(|(file, ..)| root.join(file) == path);
        for (_, find, replace) in here {
            let place = places.entry(find).or_insert((replace, Vec::new()));
            place.1.push(number);
        }
    }
    let mut lost = Vec::new();
    for (find, (replace, numbers)) in places {
        if text.matches(find).count() != 1 {
            lost.extend(numbers);
            continue;
        }
        let switch = format!("crate::broken::is(&{numbers:?})");
        *text = text.replace(find, &replace.replace("ON", &switch));
    }
    let within = |package: &str| path.starts_with(root.join(package));
    let inside = match () {
        () if within("ztl-mcu") => format!("{ENDS}::mcu::"),
        () if within("ztl-fleet") => format!("{ENDS}::fleet::"),
        () => format!("{ENDS}::link::"),
    };
    *text = text
        .replace("use crate::", &format!("use {inside}"))
        .replace("in crate::", &format!("in {inside}"))
        .replace("&crate::", &format!("&{inside}"))
        .replace("mut crate::", &format!("mut {inside}"))
        .replace("dyn crate::", &format!("dyn {inside}"));
    lost
}
