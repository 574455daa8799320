"""Shows classes and functions in the reference as readers of their sources see them."""

import re

import griffe

DOCTEST = re.compile(r"^>>> .*(?:\n.+)*", re.MULTILINE)


class Sources(griffe.Extension):
    """Extends mkdocstrings, as `mkdocs.yml` says."""

    def on_object(self, *, obj: griffe.Object, **kwargs: object) -> None:
        """Examples of docstrings are shown as code."""
        if obj.docstring:
            obj.docstring.value = DOCTEST.sub(r"```pycon\n\g<0>\n```", obj.docstring.value)

    def on_attribute_instance(self, *, attr: griffe.Attribute, **kwargs: object) -> None:
        """`x: int = eqx.field(static=True, default=1)` is shown as `x: int = 1`."""
        call = attr.value
        if isinstance(call, griffe.ExprCall) and call.canonical_name == "field":
            named = [each for each in call.arguments if isinstance(each, griffe.ExprKeyword)]
            if not any(each.name == "default_factory" for each in named):
                attr.value = next((each.value for each in named if each.name == "default"), None)

    def on_class_members(self, *, cls: griffe.Class, **kwargs: object) -> None:
        """Attributes that `__init__` sets and nothing declares are not shown."""
        for name, member in list(cls.members.items()):
            if member.labels == {"instance-attribute"} and not (
                member.annotation or member.docstring
            ):
                del cls.members[name]
