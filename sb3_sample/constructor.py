"""
Constructors declared as attributes: name, type, default, kind and meaning of an argument stand in one place, and a
class repeats nothing of what it inherits.

Type checkers and editors read the declarations as they stand (``typing.dataclass_transform``): the signature of every
class is complete without running anything. Editors show the string below a declaration for the argument, and ``help``
shows it for the class.
"""

import ast
import difflib
import functools
import inspect
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, cast, dataclass_transform

from sb3_sample.kinds import Kind

REQUIRED: Any = inspect.Parameter.empty


@dataclass(frozen=True)
class Argument:
    """
    Argument of a constructor.

    :param name: its name
    :param attribute: name that it is declared under, the attribute that holds its value
    :param default: default; ``REQUIRED`` for none
    :param kind: the kind of its values; None if that is checked elsewhere
    :param kw_only: whether it is passed by name only
    :param of_training: whether it concerns how transitions are collected, stored and drawn, or the reports of that,
        none of which applies to a learner
    :param annotation: its type
    :param meaning: the string below its declaration
    :param keeps_place: whether ``kw_only`` is that of the inherited argument, if there is one
    """

    name: str
    attribute: str
    default: Any
    kind: Kind | None
    kw_only: bool
    of_training: bool
    annotation: Any = REQUIRED
    meaning: str = ""
    keeps_place: bool = False


def argument(
    *,
    default: Any = REQUIRED,
    kind: Kind | None = None,
    kw_only: bool | None = None,
    of_training: bool = False,
    alias: str | None = None,
) -> Any:
    """
    Declare an argument of a constructor, as the value of an annotated attribute of the class. If it replaces an
    inherited argument, only the default and what is given here change.

    :param default: default; none if left out
    :param kind: the kind of its values, of ``sb3_sample.kinds``; None for the inherited argument's, or no check
    :param kw_only: whether it is passed by name only; None: as for the inherited argument, else by name only. Type
        checkers take None for True
    :param of_training: whether it does not apply to a learner
    :param alias: name of the argument, if the declaration needs another name, since the argument's type differs from
        that of the object's attribute of this name
    :return: the declaration
    """
    return Argument(alias or "", "", default, kind, kw_only is not False, of_training, keeps_place=kw_only is None)


class Given(dict[str, Any]):
    """
    Values of a constructor's arguments, by their names.

    :param values: the values
    :param passed: names of the arguments that were passed; the others have their defaults
    """

    def __init__(self, values: Mapping[str, Any], passed: Iterable[str]):
        super().__init__(values)
        self.passed = frozenset(passed)


@dataclass_transform(kw_only_default=True, eq_default=False, field_specifiers=(argument,))
class Constructed:
    """
    Base of classes whose constructors are declared as attributes. A class that defines ``__init__`` itself, or is
    derived from one that does, keeps it.

    :raises TypeError: if such a class declares arguments, which nothing would take
    """

    #: Arguments of the constructor, by name.
    constructor_arguments: ClassVar[dict[str, Argument]] = {}

    @classmethod
    def place_of(cls, name: str) -> str:
        """
        :param name: name that is not an argument of the constructor
        :return: how it is passed otherwise, as worded in the error message; empty if it is not
        """
        return ""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        attributes = list(vars(cls))
        cls.constructor_arguments = _declared(cls)
        declared = [name for name in attributes if name not in vars(cls)]
        signature = _signature(cls)
        first = next(base for base in cls.__mro__ if "__init__" in vars(base))
        others = [base for base in cls.__mro__ if hasattr(vars(base).get("__init__"), "of_declarations")]
        if first is not cls and (not others or first is others[0]):
            cls.__init__ = _constructor(cls, signature)  # type: ignore[method-assign, misc]
        elif declared:
            raise TypeError(
                f"{cls.__name__} declares {', '.join(declared)}, which __init__ of {first.__name__} does not take: "
                "define _construct(self, given) in place of that __init__, or leave the declarations out"
            )
        cls.__doc__ = _with_meanings(cls, signature)

    def _construct(self, given: Given) -> None:
        """
        Construct the object.

        :param given: the value of every argument, by its name
        """
        raise NotImplementedError


def _declared(cls: type) -> dict[str, Argument]:
    """Merge a class's declarations into the inherited ones, and delete them from it: an attribute is the object's."""
    arguments: dict[str, Argument] = {}
    for base in reversed(cls.__mro__[1:]):
        arguments |= vars(base).get("constructor_arguments", {})
    names = {known.attribute: name for name, known in arguments.items()}
    annotations, meanings = _annotations(cls), _strings_below(cls)
    for attribute, value in list(vars(cls).items()):
        # A method or a property of that name is not an argument of the constructor, unless it is annotated.
        is_default = attribute in names and (attribute in annotations or not hasattr(type(value), "__get__"))
        if not isinstance(value, Argument) and not is_default:
            continue
        inherited = arguments.get(names.get(attribute, ""))
        new = value if isinstance(value, Argument) else replace(arguments[names[attribute]], default=value)
        if inherited is not None:
            new = replace(
                new,
                name=inherited.name,
                kind=new.kind or inherited.kind,
                kw_only=inherited.kw_only if new.keeps_place else new.kw_only,
                of_training=new.of_training or inherited.of_training,
                annotation=inherited.annotation,
                meaning=inherited.meaning,
            )
        new = replace(
            new,
            name=new.name or attribute,
            attribute=attribute,
            annotation=annotations.get(attribute, new.annotation),
            meaning=meanings.get(attribute, new.meaning),
        )
        arguments[new.name] = new
        delattr(cls, attribute)
    return arguments


def _annotations(cls: type) -> dict[str, Any]:
    """Types of a class's attributes; where Python evaluates them late, a name not yet defined is no error."""
    if sys.version_info >= (3, 14):
        import annotationlib

        return annotationlib.get_annotations(cls, format=annotationlib.Format.FORWARDREF)
    return inspect.get_annotations(cls)


@functools.cache
def _classes_of(module: str) -> dict[str, ast.ClassDef]:
    """Classes in a module's source by their qualified names; none if there is no source."""
    try:
        text = inspect.getsource(sys.modules[module])
    except (KeyError, OSError, TypeError):
        text = ""
    found: dict[str, ast.ClassDef] = {}

    def walk(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef):
                found[prefix + child.name] = child
                walk(child, f"{prefix}{child.name}.")

    walk(ast.parse(text), "")
    return found


def _strings_below(cls: type) -> dict[str, str]:
    """Strings below the attributes in the class's source, by attribute."""
    node = _classes_of(cls.__module__).get(cls.__qualname__)
    found: dict[str, str] = {}
    if node is None:
        return found
    for statement, below in zip(node.body, node.body[1:], strict=False):
        is_string = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        if is_string and isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            found[statement.target.id] = " ".join(str(cast(ast.Constant, cast(ast.Expr, below).value).value).split())
    return found


def _with_meanings(cls: type[Constructed], signature: inspect.Signature) -> str:
    """The class's docstring, with its arguments before the errors that it raises."""
    description, separator, errors = inspect.cleandoc(cls.__doc__ or "").partition("\n:raises")
    wrap = functools.partial(textwrap.fill, width=100, subsequent_indent="    ", break_on_hyphens=False)
    arguments = [cls.constructor_arguments[name] for name in list(signature.parameters)[1:]]
    lines = [wrap(f":param {each.name}: {each.meaning}") for each in arguments if each.meaning]
    return "\n".join([description.rstrip(), "", *lines]) + separator + errors


def _signature(cls: type[Constructed]) -> inspect.Signature:
    """Arguments as a dataclass has them: those that are passed by position first, in the order of their declaration."""
    kinds = {False: inspect.Parameter.POSITIONAL_OR_KEYWORD, True: inspect.Parameter.KEYWORD_ONLY}
    parameters = [
        inspect.Parameter(name, kinds[each.kw_only], default=each.default, annotation=each.annotation)
        for name, each in cls.constructor_arguments.items()
    ]
    of_object = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return inspect.Signature([of_object, *sorted(parameters, key=lambda each: each.kind)])


def _constructor(cls: type[Constructed], signature: inspect.Signature) -> Callable[..., None]:
    def __init__(self: Constructed, *args: Any, **kwargs: Any) -> None:
        try:
            bound = signature.bind(self, *args, **kwargs)
        except TypeError as error:
            raise TypeError(f"{type(self).__name__}: {error}{_meant(type(self), signature, kwargs)}") from None
        passed = set(bound.arguments) - {"self"}
        bound.apply_defaults()
        given = Given(bound.arguments, passed)
        del given["self"]
        self._construct(given)

    __init__.__signature__ = signature  # type: ignore[attr-defined]
    __init__.__annotations__ = {each.name: each.annotation for each in cls.constructor_arguments.values()}
    __init__.__doc__ = f"Make a ``{cls.__name__}``; the class has the meanings of the arguments."
    __init__.of_declarations = True  # type: ignore[attr-defined]
    __init__.__module__, __init__.__qualname__ = cls.__module__, f"{cls.__qualname__}.__init__"
    return __init__


def _meant(cls: type[Constructed], signature: inspect.Signature, kwargs: dict[str, Any]) -> str:
    """Hint at where an unknown argument belongs, or at the argument that was meant, if a name is close to one."""
    unknown = [name for name in kwargs if name not in signature.parameters]
    for name in unknown:
        if place := cls.place_of(name):
            return f". It is passed as {place}"
    for name in unknown:
        if close := difflib.get_close_matches(name, signature.parameters, 1):
            return f". Did you mean {close[0]!r}?"
    return ""
