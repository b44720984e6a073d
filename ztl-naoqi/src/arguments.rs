//! Whether a method takes the arguments of a call, and which of its overloads takes them best.

use std::fmt;

use crate::encode::{Distance, Mismatch, encode};
use crate::meta_object::{MetaObject, Method};
use crate::signature::{Names, Signature};
use crate::value::Value;

/// Numbers below this are of functions that every object has.
const FIRST_OWN: u32 = 100;

/// A call whose arguments fit.
#[derive(Debug)]
pub(crate) struct Fitted<'m> {
    pub(crate) method: &'m Method,
    pub(crate) payload: Vec<u8>,
}

impl MetaObject {
    /// Checks that a method takes the arguments; `service` is for messages.
    ///
    /// # Errors
    /// [`ArgumentError`] says which argument is wrong, and what it must be.
    pub fn check(
        &self,
        service: &str,
        method: &str,
        arguments: &[Value],
    ) -> Result<(), ArgumentError> {
        self.fit(service, method, arguments).map(|_| ())
    }

    /// Chooses the overload whose types are nearest to the arguments.
    pub(crate) fn fit(
        &self,
        service: &str,
        method: &str,
        arguments: &[Value],
    ) -> Result<Fitted<'_>, ArgumentError> {
        let error = |kind| ArgumentError {
            method: format!("{service}.{method}"),
            kind,
        };
        let mut best: Option<(Distance, Fitted<'_>)> = None;
        let mut mistake = None;
        let mut tried = 0;
        for method in self.overloads(method) {
            tried += 1;
            match method.encode(arguments) {
                Ok((distance, payload)) => {
                    if best.as_ref().is_none_or(|(least, _)| distance < *least) {
                        best = Some((distance, Fitted { method, payload }));
                    }
                }
                // Of several, a wrong argument says more than a wrong count.
                Err(ArgumentErrorKind::Count { .. }) if mistake.is_some() => {}
                Err(kind) => mistake = Some(kind),
            }
        }
        if let Some((_, fitted)) = best {
            return Ok(fitted);
        }
        Err(error(match mistake {
            Some(mistake) if tried == 1 => mistake,
            Some(ArgumentErrorKind::Argument { .. } | ArgumentErrorKind::Count { .. }) => {
                ArgumentErrorKind::Overloads(self.signatures(method).unwrap_or_default())
            }
            Some(mistake) => mistake,
            None if let Some(signatures) = self.signatures(method) => {
                ArgumentErrorKind::NoOverload(signatures)
            }
            None => {
                let own = self.methods.iter().filter(|method| method.id >= FIRST_OWN);
                let mut names: Vec<&str> = own.map(|method| method.name.as_str()).collect();
                names.sort_unstable();
                names.dedup();
                ArgumentErrorKind::NoMethod(names.join(", "))
            }
        }))
    }

    /// The signatures of all methods of this name, also if it has a signature itself.
    fn signatures(&self, name: &str) -> Option<String> {
        let bare = name.split_once("::").map_or(name, |(bare, _)| bare);
        let overloads = self.overloads(bare);
        let signatures: Vec<&str> = overloads.map(|it| it.parameters.as_str()).collect();
        (!signatures.is_empty()).then(|| signatures.join(" or "))
    }
}

impl Method {
    fn encode(&self, arguments: &[Value]) -> Result<(Distance, Vec<u8>), ArgumentErrorKind> {
        let mut payload = Vec::new();
        let tuple = self.arguments().map_err(|error| {
            ArgumentErrorKind::Unreadable(format!("{:?}, {error}", self.parameters))
        })?;
        let Some(tuple) = tuple else {
            // It takes anything: a tuple of the arguments as one dynamic value.
            let all = Value::Tuple(Names::default(), arguments.into());
            let distance = encode(&all, &Signature::Dynamic, &mut payload).map_err(|mismatch| {
                ArgumentErrorKind::Argument {
                    number: 1,
                    mismatch,
                }
            })?;
            return Ok((distance.saturating_add(10), payload));
        };
        if tuple.fields.len() != arguments.len() {
            return Err(ArgumentErrorKind::Count {
                expected: tuple.fields.len(),
                found: arguments.len(),
            });
        }
        let mut sum: Distance = 0;
        for (index, (argument, signature)) in arguments.iter().zip(&tuple.fields).enumerate() {
            let distance = encode(argument, signature, &mut payload).map_err(|mismatch| {
                ArgumentErrorKind::Argument {
                    number: index + 1,
                    mismatch,
                }
            })?;
            sum = sum.saturating_add(distance);
        }
        Ok((sum, payload))
    }
}

/// Why a call cannot be made with these arguments.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ArgumentError {
    /// The service and method, as `ALMotion.moveTo`.
    pub method: String,
    /// What is wrong.
    pub kind: ArgumentErrorKind,
}

/// What is wrong with a call's arguments.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum ArgumentErrorKind {
    /// The service has no method of this name; these are the names of its methods.
    NoMethod(String),
    /// The method has no such signature; these are those that it has.
    NoOverload(String),
    /// Too many or too few arguments.
    Count {
        /// How many the method takes.
        expected: usize,
        /// How many were given.
        found: usize,
    },
    /// An argument does not fit.
    Argument {
        /// Which one, from 1.
        number: usize,
        /// Why it does not fit.
        mismatch: Mismatch,
    },
    /// No overload takes the arguments; these are the signatures of all.
    Overloads(String),
    /// The method's signature cannot be read.
    Unreadable(String),
}

impl fmt::Display for ArgumentError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { method, kind } = self;
        match kind {
            ArgumentErrorKind::NoMethod(names) if names.is_empty() => {
                write!(f, "no method {method}")
            }
            ArgumentErrorKind::NoMethod(names) => {
                let names: Vec<&str> = names.split(", ").collect();
                let shown = names.get(..20).unwrap_or(&names).join(", ");
                write!(f, "no method {method}; there are: {shown}")?;
                match names.len().saturating_sub(20) {
                    0 => Ok(()),
                    more => write!(f, " and {more} more"),
                }
            }
            ArgumentErrorKind::NoOverload(signatures) => {
                write!(f, "no method {method}; its signature is {signatures}")
            }
            ArgumentErrorKind::Count { expected, found } => {
                let plural = if *expected == 1 { "" } else { "s" };
                write!(f, "{method} takes {expected} argument{plural}, not {found}")
            }
            ArgumentErrorKind::Argument { number, mismatch } => {
                write!(f, "argument {number} of {method} {mismatch}")
            }
            ArgumentErrorKind::Overloads(signatures) => {
                write!(
                    f,
                    "{method} does not take these arguments, but {signatures}"
                )
            }
            ArgumentErrorKind::Unreadable(why) => {
                write!(f, "the signature of {method} cannot be read: {why}")
            }
        }
    }
}

impl std::error::Error for ArgumentError {}
