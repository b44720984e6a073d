//! Components that carry out nothing, for tests of what a device has besides.

/// Implements `Component` for a type: it has this name, and takes no task.
#[macro_export]
macro_rules! inert {
    ($component:ty, $name:literal) => {
        impl ::ztl_mcu::Component for $component {
            fn offer(&self) -> ::ztl_mcu::link::Offer<'_> {
                ::ztl_mcu::link::Offer::new($name)
            }

            fn check(
                &self,
                _: &str,
                _: &mut ::ztl_mcu::Report<'_>,
            ) -> Result<(), ::ztl_mcu::Refused> {
                Err(::ztl_mcu::Refused)
            }

            fn start(
                &mut self,
                _: ::ztl_mcu::Instant,
                _: &str,
                _: &mut ::ztl_mcu::Report<'_>,
            ) -> Result<(), ::ztl_mcu::Refused> {
                Err(::ztl_mcu::Refused)
            }

            fn poll(
                &mut self,
                _: ::ztl_mcu::Instant,
                _: &mut ::ztl_mcu::Report<'_>,
            ) -> ::ztl_mcu::Run {
                ::ztl_mcu::Run::Aborted
            }

            fn abort(&mut self, _: ::ztl_mcu::Instant) {}

            fn make_safe(&mut self, _: ::ztl_mcu::Instant) {}
        }
    };
}
