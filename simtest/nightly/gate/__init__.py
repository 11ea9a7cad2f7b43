"""The nightly's judge: what a night measured, held against another night by tests whose error rates are measured."""
