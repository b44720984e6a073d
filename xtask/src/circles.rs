//! No two files of a crate import each other, directly or through others: whoever opens one must not need to know all.
//!
//! A module and those inside it count as one place, so imports between them are not counted.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// A module, from the crate's root.
type Module = Vec<String>;

/// The source of each module below a directory, except tests.
fn modules(directory: &Path, path: &[String], all: &mut BTreeMap<Module, String>) {
    for entry in fs::read_dir(directory).expect("a directory").flatten() {
        let name = entry.file_name().into_string().expect("UTF-8");
        let below = |name: &str| [path, &[name.to_owned()]].concat();
        if entry.path().is_dir() && name != "bin" && name != "tests" {
            modules(&entry.path(), &below(&name), all);
        } else if let Some(name) = name.strip_suffix(".rs").filter(|name| *name != "tests") {
            let module = match name {
                "lib" | "main" | "mod" => path.to_vec(),
                name => below(name),
            };
            let text = fs::read_to_string(entry.path()).expect("text");
            let code = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
            let code: Vec<&str> = code
                .lines()
                .filter_map(|it| it.split("//").next())
                .collect();
            all.insert(module, code.join("\n"));
        }
    }
}

/// The paths that begin here, with `{a, b}` expanded. Returns what follows them.
fn paths<'t>(mut rest: &'t str, path: &[String], all: &mut Vec<Module>) -> &'t str {
    let mut path = path.to_vec();
    loop {
        rest = rest.trim_start();
        if let Some(list) = rest.strip_prefix('{') {
            rest = list;
            loop {
                rest = paths(rest, &path, all).trim_start();
                // Of `a as b`, only `a` counts.
                let end = rest.find([',', '}']).unwrap_or(rest.len());
                let (_, behind) = rest.split_at(end);
                match behind.strip_prefix(',') {
                    Some(more) => rest = more,
                    None => return behind.strip_prefix('}').unwrap_or_default(),
                }
            }
        }
        let end = rest.find(|c: char| c != '_' && !c.is_alphanumeric());
        let (name, behind) = rest.split_at(end.unwrap_or(rest.len()));
        path.push(name.to_owned());
        rest = behind;
        match rest.strip_prefix("::") {
            Some(more) => rest = more,
            None => {
                all.push(path);
                return rest;
            }
        }
    }
}

/// The modules that a module names.
fn imports(module: &Module, code: &str, all: &BTreeMap<Module, String>) -> BTreeSet<Module> {
    let mut found = Vec::new();
    for begin in ["crate::", "super::", "self::"] {
        for (at, _) in code.match_indices(begin) {
            if !code[..at].ends_with(|c: char| c == '_' || c == ':' || c.is_alphanumeric()) {
                paths(&code[at..], &[], &mut found);
            }
        }
    }
    let absolute = found.into_iter().map(|path| {
        let ups = path.iter().take_while(|name| *name == "super").count();
        let own = match path.first().map(String::as_str) {
            Some("crate") => &[],
            _ => &module[..module.len().saturating_sub(ups)],
        };
        let names = path
            .iter()
            .skip_while(|name| ["crate", "self", "super"].contains(&name.as_str()));
        own.iter().chain(names).cloned().collect::<Module>()
    });
    let named = absolute.filter_map(|path| {
        let mut prefixes = (1..=path.len()).rev().map(|length| path[..length].to_vec());
        prefixes.find(|prefix| all.contains_key(prefix))
    });
    let is_elsewhere = |other: &Module| !other.starts_with(module) && !module.starts_with(other);
    named.filter(is_elsewhere).collect()
}

/// The modules of a crate that import each other.
fn circle(source: &Path) -> Vec<String> {
    let mut all = BTreeMap::new();
    modules(source, &[], &mut all);
    let arrows: BTreeMap<&Module, BTreeSet<Module>> = all
        .iter()
        .map(|(module, code)| (module, imports(module, code, &all)))
        .collect();
    let returns = |module: &&Module| {
        let mut reached = BTreeSet::new();
        let mut next: Vec<&Module> = vec![*module];
        while let Some(one) = next.pop() {
            next.extend(arrows[one].iter().filter(|other| reached.insert(*other)));
        }
        reached.contains(*module)
    };
    all.keys()
        .filter(returns)
        .map(|module| module.join("/"))
        .collect()
}

#[test]
fn no_two_files_of_a_crate_import_each_other() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"))
        .parent()
        .expect("the project");
    for entry in fs::read_dir(root).expect("a directory").flatten() {
        let name = entry.file_name().into_string().expect("UTF-8");
        let source = entry.path().join("src");
        if (name.starts_with("ztl") || name == "xtask") && source.is_dir() {
            let circle = circle(&source);
            assert!(
                circle.is_empty(),
                "{name}: these files import each other: {circle:?}; move what both need into a third"
            );
        }
    }
}
