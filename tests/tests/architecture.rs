//! Who imports whom: no circle of files or of top-level modules in any crate, and nothing but the command line knows the command
//! line. How large types are: [`types`]. What errors of the system say: [`remedies`].
//!
//! An import is a path that leads to another file of the same crate, in a `use` or in the code. A file may use what its
//! parent module declares (Rust's privacy makes a module and its children one unit), so arrows to an ancestor do not count;
//! neither does anything under `#[cfg(test)]`.
#![allow(clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use syn::visit::{self, Visit};
use syn::{Attribute, Item, UseTree};

#[path = "architecture/remedies.rs"]
mod remedies;
#[path = "architecture/types.rs"]
mod types;

/// The folders of our crates: members of the workspace that have a library.
fn crates() -> Vec<String> {
    let text = std::fs::read_to_string(root().join("Cargo.toml")).expect("the workspace's manifest");
    let manifest: toml::Table = text.parse().expect("TOML");
    let members = manifest["workspace"]["members"].as_array().expect("members");
    let members = members.iter().filter_map(|member| member.as_str()).map(str::to_owned);
    members.filter(|member| root().join(member).join("src/lib.rs").is_file()).collect()
}

/// Names from the crate's root.
type Module = Vec<String>;

/// The modules of one crate: where each lies, and what it refers to (paths resolved to names from the root).
#[derive(Default)]
struct Crate {
    files: BTreeMap<Module, PathBuf>,
    paths: Vec<(Module, Module)>,
}

impl Crate {
    fn read(src: &Path) -> Self {
        let mut this = Self::default();
        this.file(Module::new(), &src.join("lib.rs"), src);
        this
    }

    fn file(&mut self, module: Module, file: &Path, children: &Path) {
        let text = std::fs::read_to_string(file).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        let parsed = syn::parse_file(&text).unwrap_or_else(|e| panic!("{}: {e}", file.display()));
        self.items(module, &parsed.items, file, children);
    }

    fn items(&mut self, module: Module, items: &[Item], file: &Path, children: &Path) {
        self.files.insert(module.clone(), file.to_owned());
        let items: Vec<&Item> = items.iter().filter(|i| !attributes(i).iter().any(only_for_tests)).collect();
        let mut declared = BTreeSet::new();
        for item in &items {
            let Item::Mod(child) = item else { continue };
            let name = child.ident.to_string();
            let (path, below) = ([module.clone(), vec![name.clone()]].concat(), children.join(&name));
            match &child.content {
                Some((_, inner)) => self.items(path, inner, file, &below),
                None => self.file(path, &below.with_extension("rs"), &below),
            }
            declared.insert(name);
        }
        let mut paths = Paths { module, declared, found: Vec::new() };
        items.iter().filter(|i| !matches!(i, Item::Mod(_))).for_each(|i| paths.visit_item(i));
        let from = paths.module;
        self.paths.extend(paths.found.into_iter().map(|to| (from.clone(), to)));
    }

    /// From file to file.
    fn arrows(&self) -> BTreeMap<&Path, BTreeSet<&Path>> {
        let mut arrows: BTreeMap<&Path, BTreeSet<&Path>> = BTreeMap::new();
        for (from, path) in &self.paths {
            let Some(to) = (0..=path.len()).rev().map(|n| &path[..n]).find(|m| self.files.contains_key(*m)) else {
                continue;
            };
            let (file, other) = (self.files[from].as_path(), self.files[to].as_path());
            if file != other && !from.starts_with(to) {
                arrows.entry(file).or_default().insert(other);
            }
        }
        arrows
    }

    /// From top-level module to top-level module, each with all that is below it.
    fn module_arrows(&self) -> BTreeMap<&str, BTreeSet<&str>> {
        let mut arrows: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
        let modules: BTreeSet<&str> = self.files.keys().filter_map(|m| Some(m.first()?.as_str())).collect();
        for (from, to) in &self.paths {
            let (Some(from), Some(to)) = (from.first(), to.first()) else { continue };
            if from != to && modules.contains(to.as_str()) {
                arrows.entry(from).or_default().insert(to);
            }
        }
        arrows
    }
}

/// Sets of what all reaches each other.
fn circles<'a, T: Ord + ?Sized>(arrows: &BTreeMap<&'a T, BTreeSet<&'a T>>) -> Vec<BTreeSet<&'a T>> {
    let reached: BTreeMap<&T, BTreeSet<&T>> = arrows.keys().map(|from| (*from, reached_from(*from, arrows))).collect();
    let circle = |from: &T| {
        let back = |to: &&T| reached.get(to).is_some_and(|of| of.contains(from));
        reached[from].iter().copied().filter(back).collect::<BTreeSet<&T>>()
    };
    let circles: BTreeSet<_> = arrows.keys().map(|from| circle(from)).filter(|c| !c.is_empty()).collect();
    circles.into_iter().collect()
}

fn reached_from<'a, T: Ord + ?Sized>(from: &'a T, arrows: &BTreeMap<&'a T, BTreeSet<&'a T>>) -> BTreeSet<&'a T> {
    let (mut seen, mut open) = (BTreeSet::new(), vec![from]);
    while let Some(at) = open.pop() {
        open.extend(arrows.get(at).into_iter().flatten().filter(|to| seen.insert(**to)));
    }
    seen
}

/// Collects the paths of one module that start in its own crate.
struct Paths {
    module: Module,
    declared: BTreeSet<String>,
    found: Vec<Module>,
}

impl Paths {
    fn note(&mut self, path: &[String]) {
        let mut at = match path.first().map(String::as_str) {
            Some("crate") => Module::new(),
            Some("self" | "super") => self.module.clone(),
            Some(child) if self.declared.contains(child) => [self.module.clone(), vec![child.to_owned()]].concat(),
            _ => return,
        };
        for name in &path[usize::from(path[0] != "super")..] {
            if name == "super" { drop(at.pop()) } else { at.push(name.clone()) }
        }
        self.found.push(at);
    }

    fn tree(&mut self, before: &[String], tree: &UseTree) {
        let with = |name: String| [before, &[name]].concat();
        match tree {
            UseTree::Path(p) => self.tree(&with(p.ident.to_string()), &p.tree),
            UseTree::Name(n) => self.note(&with(n.ident.to_string())),
            UseTree::Rename(r) => self.note(&with(r.ident.to_string())),
            UseTree::Glob(_) => self.note(before),
            UseTree::Group(g) => g.items.iter().for_each(|t| self.tree(before, t)),
        }
    }
}

impl<'a> Visit<'a> for Paths {
    fn visit_item_use(&mut self, item: &'a syn::ItemUse) {
        self.tree(&[], &item.tree);
    }

    fn visit_path(&mut self, path: &'a syn::Path) {
        let names: Vec<String> = path.segments.iter().map(|s| s.ident.to_string()).collect();
        if names.len() > 1 {
            self.note(&names);
        }
        visit::visit_path(self, path);
    }
}

fn attributes(item: &Item) -> &[Attribute] {
    match item {
        Item::Const(syn::ItemConst { attrs, .. })
        | Item::Enum(syn::ItemEnum { attrs, .. })
        | Item::Fn(syn::ItemFn { attrs, .. })
        | Item::Impl(syn::ItemImpl { attrs, .. })
        | Item::Macro(syn::ItemMacro { attrs, .. })
        | Item::Mod(syn::ItemMod { attrs, .. })
        | Item::Static(syn::ItemStatic { attrs, .. })
        | Item::Struct(syn::ItemStruct { attrs, .. })
        | Item::Trait(syn::ItemTrait { attrs, .. })
        | Item::Type(syn::ItemType { attrs, .. })
        | Item::Use(syn::ItemUse { attrs, .. }) => attrs,
        _ => &[],
    }
}

/// `cfg(test)`, `cfg(all(test, …))`.
fn only_for_tests(attribute: &Attribute) -> bool {
    let list = attribute.meta.require_list().map(|l| l.tokens.to_string()).unwrap_or_default();
    attribute.path().is_ident("cfg") && list.split(|c: char| !c.is_alphanumeric()).any(|word| word == "test")
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace")
}

#[test]
fn no_files_of_a_crate_import_each_other_in_a_circle() {
    let crates = crates();
    assert!(crates.iter().any(|name| name.contains('/')), "nested crates are found: {crates:?}");
    for name in crates {
        let all = Crate::read(&root().join(&name).join("src"));
        let found = circles(&all.arrows());
        assert_eq!(found, Vec::<BTreeSet<&Path>>::new(), "files of {name} import each other in a circle");
    }
}

#[test]
fn no_top_level_modules_of_a_crate_import_each_other_in_a_circle() {
    for name in crates() {
        let all = Crate::read(&root().join(&name).join("src"));
        let found = circles(&all.module_arrows());
        assert_eq!(found, Vec::<BTreeSet<&str>>::new(), "modules of {name} import each other in a circle");
    }
}

#[test]
fn nothing_outside_the_command_line_imports_it() {
    let src = root().join("runtime/src");
    let all = Crate::read(&src);
    let inside = |file: &Path| file == src.join("cli.rs") || file.starts_with(src.join("cli"));
    let arrows = all.arrows();
    let importers = arrows.iter().filter(|(from, to)| !inside(from) && to.iter().any(|to| inside(to)));
    let importers: Vec<_> = importers.map(|(from, _)| from).collect();
    assert!(importers.is_empty(), "{importers:?} import cli");
    assert!(arrows.keys().any(|from| inside(from)), "the command line imports something");
}

#[test]
fn a_circle_is_found_and_a_parent_or_a_test_is_none() {
    let dir = tempfile::tempdir().expect("tempdir");
    let write = |name: &str, text: &str| {
        let path = dir.path().join(name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("mkdir");
        std::fs::write(path, text).expect("write");
    };
    write("lib.rs", "mod a;\nmod b;\nmod c;\npub struct Root;");
    write("a.rs", "use crate::b::{Two, deeper::Three};\nuse crate::Root;");
    write("b.rs", "pub mod deeper;\npub struct Two;\nuse deeper::Three;\n#[cfg(test)]\nmod tests { use crate::a::X; }");
    write("b/deeper.rs", "use super::Two;\npub struct Three;\nfn f() { crate::c::g() }");
    write("c.rs", "use super::Root;\npub fn g() {}");
    let all = Crate::read(dir.path());
    assert_eq!(circles(&all.arrows()), Vec::<BTreeSet<&Path>>::new());
    assert_eq!(circles(&all.module_arrows()), Vec::<BTreeSet<&str>>::new());
    write("c.rs", "pub fn g() { let _ = super::a::f; }");
    let all = Crate::read(dir.path());
    let found = circles(&all.arrows());
    let names = |c: &BTreeSet<&Path>| c.iter().filter_map(|p| p.file_name()?.to_str()).collect::<Vec<_>>().join(" ");
    assert_eq!(found.iter().map(names).collect::<Vec<_>>(), ["a.rs deeper.rs b.rs c.rs"]);
    // No circle of files, and yet one of modules: one file of b imports a, and a imports another one of b.
    write("b.rs", "pub mod deeper;\npub mod other;");
    write("b/other.rs", "pub fn o() {}");
    write("b/deeper.rs", "fn f() { crate::a::g() }");
    write("a.rs", "use crate::b::other::o;\npub fn g() {}");
    write("c.rs", "");
    let all = Crate::read(dir.path());
    assert_eq!(circles(&all.arrows()), Vec::<BTreeSet<&Path>>::new());
    assert_eq!(circles(&all.module_arrows()), [BTreeSet::from(["a", "b"])]);
}
