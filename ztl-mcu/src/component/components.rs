//! The components of a node, by their index.

use ztl_core::Instant;

use super::Component;
use crate::acting::OwnWork;
use crate::bus::BusState;
use crate::parameters::Tuning;
use crate::update::{UpdateState, Updater};

/// The components of a node: an array of one type, a tuple of up to twelve types, or a mutable reference to
/// either or to a slice, such as `&mut [&mut dyn Component]`.
///
/// Their order gives their index on the link.
pub trait Components {
    /// Whether they [describe](Self::description) themselves. If not, the node has no code for it.
    const DESCRIBED: bool = false;

    /// Whether the firmware starts tasks itself and reports events. If not, the node contains no code for either.
    const ACTING: bool = false;

    /// Number of parameters that clients may set. With 0, the node contains no code for parameters.
    const PARAMETER_COUNT: u8 = 0;

    /// Whether the firmware takes updates over the link. If not, the node contains no code for them.
    const UPDATES: bool = false;

    /// Number of components; the first 255 are used.
    fn count(&self) -> usize;

    /// The component with this index.
    fn component(&self, index: usize) -> Option<&dyn Component>;

    /// The component with this index, mutable.
    fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component>;

    /// The state of a node on a shared line, from [`OnBus`](crate::bus::OnBus). Without it, the node has no code for that.
    fn bus(&self) -> Option<&BusState> {
        None
    }

    /// Like [`bus`](Self::bus), mutable.
    fn bus_mut(&mut self) -> Option<&mut BusState> {
        None
    }

    /// The [tick](Component::next_tick) of the component with this index, or [`Instant::NEVER`]. An implementation that
    /// knows the components' types calls them directly: firmware without ticks then has no code for them.
    fn next_tick(&self, index: usize) -> Instant {
        self.component(index)
            .map_or(Instant::NEVER, Component::next_tick)
    }

    /// The [long result](Component::result) of the component with this index, or nothing. An implementation that knows the
    /// components' types calls them directly: firmware without long results then has no code for them.
    fn result(&self, index: usize) -> &str {
        self.component(index).map_or("", Component::result)
    }

    /// What a component says of itself, in JSON (`docs/protocol.md` [11.7]); empty if it says nothing.
    /// [`Described`](crate::describe::Described) knows it from the components' types. All of them together must fit
    /// into 48 bytes for each index up to 255 that is not a component's; more is never sent.
    fn description(&self, index: usize) -> &str {
        let _ = index;
        ""
    }

    /// What the firmware does itself; only [`Acting`](crate::Acting) has it.
    fn own_work(&self) -> Option<&OwnWork> {
        None
    }

    /// The same, mutable.
    fn own_work_mut(&mut self) -> Option<&mut OwnWork> {
        None
    }

    /// Their parameters; [`Tuned`](crate::parameters::Tuned) has some.
    fn tuning(&self) -> Option<&dyn Tuning> {
        None
    }

    /// Their parameters, mutable.
    fn tuning_mut(&mut self) -> Option<&mut dyn Tuning> {
        None
    }

    /// The firmware's updates; only [`Updatable`](crate::update::Updatable) has some.
    fn update(&self) -> Option<(&UpdateState, &dyn Updater)> {
        None
    }

    /// The same, mutable.
    fn update_mut(&mut self) -> Option<(&mut UpdateState, &mut dyn Updater)> {
        None
    }
}

impl<T: Component> Components for [T] {
    fn count(&self) -> usize {
        self.len()
    }

    fn component(&self, index: usize) -> Option<&dyn Component> {
        self.get(index).map(|one| one as &dyn Component)
    }

    fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component> {
        self.get_mut(index).map(|one| one as &mut dyn Component)
    }

    fn next_tick(&self, index: usize) -> Instant {
        self.get(index).map_or(Instant::NEVER, T::next_tick)
    }

    fn result(&self, index: usize) -> &str {
        self.get(index).map_or("", T::result)
    }
}

impl<T: Component, const N: usize> Components for [T; N] {
    fn count(&self) -> usize {
        N
    }

    fn component(&self, index: usize) -> Option<&dyn Component> {
        self.as_slice().component(index)
    }

    fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component> {
        self.as_mut_slice().component_mut(index)
    }

    fn next_tick(&self, index: usize) -> Instant {
        self.as_slice().next_tick(index)
    }

    fn result(&self, index: usize) -> &str {
        self.as_slice().result(index)
    }
}

impl<C: Components + ?Sized> Components for &mut C {
    const DESCRIBED: bool = C::DESCRIBED;
    const ACTING: bool = C::ACTING;
    const PARAMETER_COUNT: u8 = C::PARAMETER_COUNT;
    const UPDATES: bool = C::UPDATES;

    fn count(&self) -> usize {
        C::count(self)
    }

    fn component(&self, index: usize) -> Option<&dyn Component> {
        C::component(self, index)
    }

    fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component> {
        C::component_mut(self, index)
    }

    fn next_tick(&self, index: usize) -> Instant {
        C::next_tick(self, index)
    }

    fn result(&self, index: usize) -> &str {
        C::result(self, index)
    }

    fn description(&self, index: usize) -> &str {
        C::description(self, index)
    }

    fn bus(&self) -> Option<&BusState> {
        C::bus(self)
    }

    fn bus_mut(&mut self) -> Option<&mut BusState> {
        C::bus_mut(self)
    }

    fn own_work(&self) -> Option<&OwnWork> {
        C::own_work(self)
    }

    fn own_work_mut(&mut self) -> Option<&mut OwnWork> {
        C::own_work_mut(self)
    }

    fn tuning(&self) -> Option<&dyn Tuning> {
        C::tuning(self)
    }

    fn tuning_mut(&mut self) -> Option<&mut dyn Tuning> {
        C::tuning_mut(self)
    }

    fn update(&self) -> Option<(&UpdateState, &dyn Updater)> {
        C::update(self)
    }

    fn update_mut(&mut self) -> Option<(&mut UpdateState, &mut dyn Updater)> {
        C::update_mut(self)
    }
}

/// Implements parts of [`Components`] for a wrapper by those of the components in this field.
macro_rules! forward {
    ($field:tt: $($part:ident)+) => {
        $(forward!(@$part $field);)+
    };
    (@parts $field:tt) => {
        fn count(&self) -> usize {
            self.$field.count()
        }

        fn component(&self, index: usize) -> Option<&dyn crate::component::Component> {
            self.$field.component(index)
        }

        fn component_mut(
            &mut self,
            index: usize,
        ) -> Option<&mut dyn crate::component::Component> {
            self.$field.component_mut(index)
        }

        fn next_tick(&self, index: usize) -> ::ztl_core::Instant {
            self.$field.next_tick(index)
        }

        fn result(&self, index: usize) -> &str {
            self.$field.result(index)
        }
    };
    (@descriptions $field:tt) => {
        const DESCRIBED: bool = C::DESCRIBED;

        fn description(&self, index: usize) -> &str {
            self.$field.description(index)
        }
    };
    (@bus $field:tt) => {
        fn bus(&self) -> Option<&crate::bus::BusState> {
            self.$field.bus()
        }

        fn bus_mut(&mut self) -> Option<&mut crate::bus::BusState> {
            self.$field.bus_mut()
        }
    };
    (@own_work $field:tt) => {
        const ACTING: bool = C::ACTING;

        fn own_work(&self) -> Option<&crate::acting::OwnWork> {
            self.$field.own_work()
        }

        fn own_work_mut(&mut self) -> Option<&mut crate::acting::OwnWork> {
            self.$field.own_work_mut()
        }
    };
    (@parameters $field:tt) => {
        const PARAMETER_COUNT: u8 = C::PARAMETER_COUNT;

        fn tuning(&self) -> Option<&dyn crate::parameters::Tuning> {
            self.$field.tuning()
        }

        fn tuning_mut(&mut self) -> Option<&mut dyn crate::parameters::Tuning> {
            self.$field.tuning_mut()
        }
    };
    (@updates $field:tt) => {
        const UPDATES: bool = C::UPDATES;

        fn update(
            &self,
        ) -> Option<(
            &crate::update::UpdateState,
            &dyn crate::update::Updater,
        )> {
            self.$field.update()
        }

        fn update_mut(
            &mut self,
        ) -> Option<(
            &mut crate::update::UpdateState,
            &mut dyn crate::update::Updater,
        )> {
            self.$field.update_mut()
        }
    };
}
pub(crate) use forward;

macro_rules! tuples {
    ($($count:literal: $($name:ident $index:tt),+;)+) => {
        $(impl<$($name: Component),+> Components for ($($name,)+) {
            fn count(&self) -> usize {
                $count
            }

            fn component(&self, index: usize) -> Option<&dyn Component> {
                match index {
                    $($index => Some(&self.$index),)+
                    _ => None,
                }
            }

            fn component_mut(&mut self, index: usize) -> Option<&mut dyn Component> {
                match index {
                    $($index => Some(&mut self.$index),)+
                    _ => None,
                }
            }

            fn next_tick(&self, index: usize) -> Instant {
                match index {
                    $($index => self.$index.next_tick(),)+
                    _ => Instant::NEVER,
                }
            }

            fn result(&self, index: usize) -> &str {
                match index {
                    $($index => self.$index.result(),)+
                    _ => "",
                }
            }
        })+
    };
}

tuples! {
    1: A 0;
    2: A 0, B 1;
    3: A 0, B 1, C 2;
    4: A 0, B 1, C 2, D 3;
    5: A 0, B 1, C 2, D 3, E 4;
    6: A 0, B 1, C 2, D 3, E 4, F 5;
    7: A 0, B 1, C 2, D 3, E 4, F 5, G 6;
    8: A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7;
    9: A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8;
    10: A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8, J 9;
    11: A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8, J 9, K 10;
    12: A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8, J 9, K 10, L 11;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::component::{Refused, Report, Run};
    use ztl_core::link::Offer;

    /// A component that only has a name.
    struct Named(&'static str);

    impl Component for Named {
        fn offer(&self) -> Offer<'_> {
            Offer::new(self.0)
        }

        fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
            Err(Refused)
        }

        fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
            Err(Refused)
        }

        fn poll(&mut self, _: Instant, _: &mut Report<'_>) -> Run {
            Run::Failed
        }

        fn abort(&mut self, _: Instant) {}

        fn make_safe(&mut self, _: Instant) {}
    }

    fn names(mut components: impl Components) -> std::vec::Vec<std::string::String> {
        assert!(components.component(components.count()).is_none());
        assert!(components.component_mut(components.count()).is_none());
        let mut names = std::vec::Vec::new();
        for index in 0..components.count() {
            let name = components.component(index).unwrap().offer().name.into();
            names.push(name);
            let again = components.component_mut(index).unwrap();
            assert_eq!(names[index], again.offer().name);
        }
        names
    }

    #[test]
    fn arrays_tuples_and_references_keep_their_component_order() {
        assert_eq!(names([Named("a"), Named("b")]), ["a", "b"]);
        assert_eq!(names((Named("a"),)), ["a"]);
        let [a, b, c] = ["a", "b", "c"].map(|name| move || Named(name));
        let twelve = (a(), b(), c(), a(), b(), c(), a(), b(), c(), a(), b(), c());
        assert_eq!(names(twelve), ["a", "b", "c"].repeat(4));
        let (mut one, mut other) = (Named("b"), Named("c"));
        assert_eq!(names((Named("a"), &mut one, &mut other)), ["a", "b", "c"]);
        let mut list: [&mut dyn Component; 2] = [&mut one, &mut other];
        assert_eq!(names(&mut list), ["b", "c"]);
        let slice: &mut [&mut dyn Component] = &mut list;
        assert_eq!(names(slice), ["b", "c"]);
    }
}
