//! The description of an object: its methods, signals and properties, by name and signature.

use crate::signature::{Signature, SignatureError, Tuple};

/// How deep the signatures of methods may be nested.
const DEPTH: usize = 32;

/// An object that a method has returned.
#[derive(Debug, Clone, PartialEq)]
pub struct Object {
    /// Its description.
    pub meta: MetaObject,
    /// The service that it belongs to.
    pub service: u32,
    /// Its number there.
    pub object: u32,
}

/// The description of an object or service.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MetaObject {
    /// Its methods, by their numbers.
    pub methods: Vec<Method>,
    /// Its signals.
    pub signals: Vec<Member>,
    /// Its properties.
    pub properties: Vec<Member>,
}

/// A method.
#[derive(Debug, Clone, PartialEq)]
pub struct Method {
    /// Its number.
    pub id: u32,
    /// Its name; overloads share it.
    pub name: String,
    /// The signature of its arguments.
    pub parameters: String,
    /// The signature of what it returns.
    pub returns: String,
}

/// A signal or property.
#[derive(Debug, Clone, PartialEq)]
pub struct Member {
    /// Its number.
    pub id: u32,
    /// Its name.
    pub name: String,
    /// The signature of its value.
    pub signature: String,
}

impl MetaObject {
    /// The signal with this name.
    #[must_use]
    pub fn signal(&self, name: &str) -> Option<&Member> {
        self.signals.iter().find(|signal| signal.name == name)
    }

    /// The methods with this name: `say`, or one of them, `say::(s)`.
    pub fn overloads(&self, name: &str) -> impl Iterator<Item = &Method> {
        let (name, signature) = match name.split_once("::") {
            Some((name, signature)) => (name, Some(signature)),
            None => (name, None),
        };
        self.methods.iter().filter(move |method| {
            method.name == name && signature.is_none_or(|signature| method.parameters == signature)
        })
    }
}

impl Method {
    /// The types of its arguments; nothing if it takes any.
    ///
    /// # Errors
    /// The signature cannot be read.
    pub fn arguments(&self) -> Result<Option<Tuple>, SignatureError> {
        match Signature::parse(&self.parameters, DEPTH)? {
            Signature::Tuple(tuple) => Ok(Some(tuple)),
            _ => Ok(None),
        }
    }
}
