// The table that Python reads: names, signatures, entries.
//
// SP_KERNELS(subject, ONE(name), BOTH(name), ...) at the end of native/SUBJECT.cpp lists its kernels. A kernel is an
// ordinary function over arrays and numbers that ends in (i64 thread, i64 threads); BOTH and FLOAT_FIRST are
// templates over float and double. The parameter list is the only declaration: it becomes text at compile time,
// against which Python checks.
#pragma once
#include "arrays.h"
#include "lanes.h"

namespace sp {

struct Kernel {
    const char* name;
    // Per parameter, with a space behind: dtype as numpy writes it, number of dimensions (0: a number), r or w, and the
    // number of entries of the last dimension where that is fixed.
    const char* signature;
    void (*call)(const Argument*, i64 thread, i64 threads);
};

namespace {

template <class T> struct CodeOf;
template <class T> struct CodeOf<const T> : CodeOf<T> {};
#define SP_CODE(T, c) template <> struct CodeOf<T> { static constexpr char value = c; };
SP_CODE(float, 'f') SP_CODE(double, 'd') SP_CODE(bool, '?') SP_CODE(i8, 'b') SP_CODE(u8, 'B') SP_CODE(i16, 'h')
SP_CODE(u16, 'H') SP_CODE(i32, 'i') SP_CODE(u32, 'I') SP_CODE(i64, 'q') SP_CODE(u64, 'Q')
#undef SP_CODE
template <class T> constexpr bool IS_CONST = false;
template <class T> constexpr bool IS_CONST<const T> = true;

struct Text {
    char text[640] = {};
    int size = 0;
    constexpr void add(char c) { text[size++] = c; }
    constexpr void number(i64 value) {
        if (value >= 10) number(value / 10);
        add(char('0' + value % 10));
    }
};

// As many characters as there are: the library holds one for each kernel.
template <int SIZE> struct Trimmed { char text[SIZE] = {}; };
template <int SIZE> constexpr Trimmed<SIZE> trimmed(const Text& from) {
    Trimmed<SIZE> out;
    for (int k = 0; k < SIZE; ++k) out.text[k] = from.text[k];
    return out;
}

// One parameter: how it is read from an Argument, and its word in the signature.
template <class T> struct Parameter {  // i64 or bool
    static T read(const Argument& a) { return (T)a.shape[0]; }
    static constexpr void write(Text& out) { out.add(CodeOf<T>::value), out.add('0'), out.add('r'), out.add(' '); }
};
template <> struct Parameter<double> {
    static double read(const Argument& a) { return bits_of<double>(a.shape[0]); }
    static constexpr void write(Text& out) { out.add('d'), out.add('0'), out.add('r'), out.add(' '); }
};
template <> struct Parameter<float> {
    static float read(const Argument& a) { return (float)bits_of<double>(a.shape[0]); }
    static constexpr void write(Text& out) { out.add('f'), out.add('0'), out.add('r'), out.add(' '); }
};
template <class T, int N, i64 FIXED> struct Parameter<Array<T, N, FIXED>> {
    static_assert(N >= 1 && N <= 4);
    static Array<T, N, FIXED> read(const Argument& a) {
        Array<T, N, FIXED> out;
        out.data = static_cast<T*>(a.data);
        for (int k = 0; k < N; ++k) out.shape[k] = a.shape[k];
        return out;
    }
    static constexpr void write(Text& out) {
        out.add(CodeOf<T>::value), out.add(char('0' + N)), out.add(IS_CONST<T> ? 'r' : 'w');
        if (FIXED) out.number(FIXED);
        out.add(' ');
    }
};

template <int... K> struct Indices {};
template <int N, int... K> struct CountTo : CountTo<N - 1, N - 1, K...> {};
template <int... K> struct CountTo<0, K...> { using type = Indices<K...>; };

// Splits the two last parameters off.
template <class... P> struct Parameters {};
template <class Done, class... P> struct WithoutThreads;
template <class... D> struct WithoutThreads<Parameters<D...>, i64, i64> { using type = Parameters<D...>; };
template <class... D, class A, class B, class C, class... P>
struct WithoutThreads<Parameters<D...>, A, B, C, P...> : WithoutThreads<Parameters<D..., A>, B, C, P...> {};

template <auto function, class Signature> struct Entry;
template <auto function, class... P> struct Entry<function, void (*)(P...)> {
    static constexpr int COUNT = (int)sizeof...(P) - 2;
    template <class... A, int... K>
    SP_INLINE static void unpack(const Argument* a, i64 thread, i64 threads, Parameters<A...>, Indices<K...>) {
        function(Parameter<A>::read(a[K])..., thread, threads);
    }
    template <class... A> static constexpr Text text_of(Parameters<A...>) {
        Text out;
        (Parameter<A>::write(out), ...);
        return out;
    }
    using Bare = typename WithoutThreads<Parameters<>, P...>::type;
    static void call(const Argument* a, i64 thread, i64 threads) {
        unpack(a, thread, threads, Bare{}, typename CountTo<COUNT>::type{});
    }
    SP_SMALL static void call_small(const Argument* a, i64 thread, i64 threads) {
        unpack(a, thread, threads, Bare{}, typename CountTo<COUNT>::type{});
    }
    static constexpr auto signature = trimmed<text_of(Bare{}).size + 1>(text_of(Bare{}));
};

template <auto function> constexpr Kernel kernel(const char* name) {
    using E = Entry<function, decltype(function)>;
    return {name, E::signature.text, &E::call};
}
// Of forms that are seldom asked for.
template <auto function> constexpr Kernel small_kernel(const char* name) {
    using E = Entry<function, decltype(function)>;
    return {name, E::signature.text, &E::call_small};
}

} }  // namespace sp

#define SP_JOIN2(a, b) a##_##b
#define SP_JOIN(a, b) SP_JOIN2(a, b)
#define BOTH(f) kernel<&f<float>>(#f), kernel<&f<double>>(#f)
#define ONE(f) kernel<&f>(#f)
// As BOTH; the double form, which tests and finite differences ask for, is that of v3 on v4 too (splatpainter/kernels/
// library.py fills it in): a ninth of the time that all kernels take to compile.
#ifdef SP_KIND_v4
#define FLOAT_FIRST(f) kernel<&f<float>>(#f)
#else
#define FLOAT_FIRST(f) kernel<&f<float>>(#f), small_kernel<&f<double>>(#f)
#endif
#define SP_KERNELS(subject, ...)                                                     \
    namespace sp {                                                                   \
    extern const Kernel SP_JOIN(kernels_##subject, SP_TARGET)[] = {__VA_ARGS__, {nullptr, nullptr, nullptr}}; \
    }
// Of a subject that wider vectors hardly quicken: the kernels of v3 serve on v4 too.
#ifdef SP_KIND_v4
#define SP_KERNELS_TO_V3(subject, ...) \
    namespace sp { extern const Kernel SP_JOIN(kernels_##subject, SP_TARGET)[] = {{nullptr, nullptr, nullptr}}; }
#else
#define SP_KERNELS_TO_V3(subject, ...) SP_KERNELS(subject, __VA_ARGS__)
#endif
// Of a subject in which no vectors serve: one copy for all.
#if defined(SP_KIND_v3) || defined(SP_KIND_v4)
#define SP_KERNELS_TO_BASE(subject, ...) \
    namespace sp { extern const Kernel SP_JOIN(kernels_##subject, SP_TARGET)[] = {{nullptr, nullptr, nullptr}}; }
#else
#define SP_KERNELS_TO_BASE(subject, ...) SP_KERNELS(subject, __VA_ARGS__)
#endif
