// The file as text: SHA-256, strict JSON, canonical text, number texts (format page, section 1).
#pragma once
#include "exact.hpp"
#include <memory>
#include <set>

struct Refused : std::runtime_error {
    using std::runtime_error::runtime_error;
};
[[noreturn]] inline void refuse(const std::string& why) { throw Refused(why); }

inline std::string sha256(std::string text) {  // FIPS 180-4
    // the first 32 bits of the fractional parts of the cube roots of the first 64 primes, and of the
    // square roots of the first 8, made here in whole numbers
    static std::vector<uint32_t> K, H0;
    if (K.empty()) {
        for (int p = 2; K.size() < 64; ++p) {
            bool prime = true;
            for (int d = 2; d * d <= p; ++d) prime &= p % d != 0;
            if (!prime) continue;
            const auto root = [&](int power) {  // floor(p^(1/power) · 2^32) mod 2^32
                Whole low(0), high(shift(1, 36)), target = shift(Whole(p), 32 * power);
                while ((high - low - Whole(1)).sign() > 0) {
                    const Whole mid = shift(low + high, -1);
                    const Whole value = power == 2 ? mid * mid : mid * mid * mid;
                    ((value - target).sign() <= 0 ? low : high) = mid;
                }
                return low.limb[0];
            };
            K.push_back(root(3));
            if (H0.size() < 8) H0.push_back(root(2));
        }
    }
    std::vector<uint32_t> h = H0;
    const uint64_t length = 8 * uint64_t(text.size());
    text += char(0x80);
    while (text.size() % 64 != 56) text += char(0);
    for (int i = 7; i >= 0; --i) text += char(length >> (8 * i));
    const auto turn = [](uint32_t x, int by) { return (x >> by) | (x << (32 - by)); };
    for (size_t at = 0; at < text.size(); at += 64) {
        uint32_t w[64];
        for (int i = 0; i < 16; ++i) {
            w[i] = 0;
            for (int j = 0; j < 4; ++j) w[i] = (w[i] << 8) | uint8_t(text[at + 4 * i + j]);
        }
        for (int i = 16; i < 64; ++i)
            w[i] = w[i - 16] + (turn(w[i - 15], 7) ^ turn(w[i - 15], 18) ^ (w[i - 15] >> 3)) +
                   w[i - 7] + (turn(w[i - 2], 17) ^ turn(w[i - 2], 19) ^ (w[i - 2] >> 10));
        std::vector<uint32_t> v = h;
        for (int i = 0; i < 64; ++i) {
            const uint32_t a = v[0], e = v[4];
            const uint32_t t1 = v[7] + (turn(e, 6) ^ turn(e, 11) ^ turn(e, 25)) +
                                ((e & v[5]) ^ (~e & v[6])) + K[i] + w[i];
            const uint32_t t2 = (turn(a, 2) ^ turn(a, 13) ^ turn(a, 22)) +
                                ((a & v[1]) ^ (a & v[2]) ^ (v[1] & v[2]));
            v = {t1 + t2, a, v[1], v[2], v[3] + t1, e, v[5], v[6]};
        }
        for (int i = 0; i < 8; ++i) h[i] += v[i];
    }
    std::string out;
    for (uint32_t x : h)
        for (int i = 28; i >= 0; i -= 4) out += "0123456789abcdef"[(x >> i) & 15];
    return out;
}

struct Json {
    enum Kind { null, whole, text, list, object } kind = null;
    int64_t number = 0;
    std::string string;
    std::vector<Json> items;
    std::map<std::string, Json> keys;  // sorted by bytes, which in UTF-8 is by code points

    std::string canonical(const std::string& without = "") const {
        std::string out;
        switch (kind) {
        case null: return "null";
        case whole: return std::to_string(number);
        case text: return "\"" + string + "\"";
        case list:
            for (const Json& item : items) out += (out.empty() ? "" : ",") + item.canonical();
            return "[" + out + "]";
        case object:
            for (const auto& [key, value] : keys)
                if (without.empty() || key != without)
                    out += (out.empty() ? "\"" : ",\"") + key + "\":" + value.canonical();
            return "{" + out + "}";
        }
        return out;
    }
};

// Code points of UTF-8 text; refuses what is not UTF-8 and what is no printable character.
inline size_t characters(const std::string& text) {
    size_t count = 0;
    for (size_t i = 0; i < text.size(); ++count) {
        const uint8_t first = uint8_t(text[i++]);
        const int more = first < 0x80 ? 0 : first >= 0xC2 && first < 0xE0 ? 1
                         : (first & 0xF0) == 0xE0                       ? 2
                         : first >= 0xF0 && first < 0xF5                ? 3
                                                                        : -1;
        if (more < 0) refuse("a text is not UTF-8");
        uint32_t code = more ? first & (0x3F >> more) : first;
        for (int k = 0; k < more; ++k) {
            if (i >= text.size() || (uint8_t(text[i]) & 0xC0) != 0x80) refuse("a text is not UTF-8");
            code = (code << 6) | (uint8_t(text[i++]) & 0x3F);
        }
        const uint32_t least[] = {0, 0x80, 0x800, 0x10000};
        if (code < least[more] || code > 0x10FFFF || (code >= 0xD800 && code < 0xE000))
            refuse("a text is not UTF-8");
        if (code < 0x20 || (code >= 0x7F && code < 0xA0) || code == 0x2028 || code == 0x2029)
            refuse("a text holds a control character");
    }
    return count;
}

class Parser {
    const std::string& s;
    size_t at = 0;

    void space() {
        while (at < s.size() && (s[at] == ' ' || s[at] == '\t' || s[at] == '\n' || s[at] == '\r')) ++at;
    }
    [[noreturn]] void bad(const char* what) const {
        refuse(std::string("not JSON of this format at byte ") + std::to_string(at) + ": " + what);
    }
    bool take(char c) {
        space();
        if (at >= s.size() || s[at] != c) return false;
        ++at;
        return true;
    }
    std::string quoted() {
        if (!take('"')) bad("a text is expected");
        const size_t from = at;
        while (at < s.size() && s[at] != '"') {
            if (s[at] == '\\') bad("a backslash");
            ++at;
        }
        if (at >= s.size()) bad("a text without end");
        std::string out = s.substr(from, at++ - from);
        characters(out);
        return out;
    }
    Json value(int depth) {
        if (depth > 16) bad("nested deeper than 16");
        Json out;
        space();
        if (at >= s.size()) bad("the end comes early");
        if (s[at] == '{') {
            out.kind = Json::object;
            ++at;
            if (take('}')) return out;
            do {
                std::string key = quoted();
                if (!take(':')) bad("a colon is expected");
                if (!out.keys.emplace(key, value(depth + 1)).second) bad("a key occurs twice");
            } while (take(','));
            if (!take('}')) bad("a brace is expected");
        } else if (s[at] == '[') {
            out.kind = Json::list;
            ++at;
            if (take(']')) return out;
            do out.items.push_back(value(depth + 1));
            while (take(','));
            if (!take(']')) bad("a bracket is expected");
        } else if (s[at] == '"') {
            out.kind = Json::text;
            out.string = quoted();
        } else if (s.compare(at, 4, "null") == 0) {
            at += 4;
        } else {
            out.kind = Json::whole;
            const size_t from = at;
            while (at < s.size() && s[at] >= '0' && s[at] <= '9') ++at;
            if (at == from || at - from > 10 || (s[from] == '0' && at - from > 1))
                bad("a whole number is expected");
            out.number = std::stoll(s.substr(from, at - from));
            if (out.number >= int64_t(1) << 31) bad("a number is 2^31 or more");
        }
        return out;
    }

public:
    explicit Parser(const std::string& text) : s(text) {}
    Json document() {
        if (s.size() > 4000000) refuse("the file has more than 4,000,000 bytes");
        Json out = value(1);
        space();
        if (at != s.size()) bad("something follows the document");
        return out;
    }
};

// No number but 0 is smaller than the least positive double, or larger than the largest.
inline const Fraction& usual_size(const Fraction& x) {
    static const Fraction least = scaled(1, -1074), largest(shift(1, 1024) - shift(1, 971), 1);
    const Fraction size = x.sign() < 0 ? -x : x;
    if (x.sign() && (size > largest || size < least)) refuse("a number beyond the doubles");
    return x;
}

inline Fraction number_text(const std::string& s) {
    const auto bad = [&]() { refuse("a number text is not of the grammar"); };
    if (s.empty() || s.size() > 420) bad();
    size_t at = s[0] == '-';
    const bool negative = at;
    const auto natural = [&]() {
        const size_t from = at;
        Whole value;
        while (at < s.size() && s[at] >= '0' && s[at] <= '9') value = value * 10 + Whole(s[at++] - '0');
        if (at == from || (s[from] == '0' && at - from > 1)) bad();
        return value;
    };
    const auto signed_as = [&](const Fraction& x) { return usual_size(negative ? -x : x); };
    if (s.compare(at, 2, "0x") == 0) {
        at += 2;
        if (s.size() < at + 17 || (s[at] != '0' && s[at] != '1') || s[at + 1] != '.') bad();
        Whole digits(s[at] - '0');
        for (size_t i = at + 2; i < at + 15; ++i) {
            const char* place = std::char_traits<char>::find("0123456789abcdef", 16, s[i]);
            if (!place) bad();
            digits = digits * 16 + Whole(place - "0123456789abcdef");
        }
        at += 15;
        if (s[at] != 'p') bad();
        ++at;
        if (at >= s.size() || (s[at] != '+' && s[at] != '-')) bad();
        const bool down = s[at++] == '-';
        const Whole size = natural();
        if (at != s.size() || size.bits() > 11) bad();
        const long e = (size.zero() ? 0 : long(size.limb[0])) * (down ? -1 : 1);
        if (e < -1022 || e > 1023) bad();
        return signed_as(scaled(digits, e - 52));
    }
    const Whole top = natural();
    if (at == s.size()) return signed_as(Fraction(top, 1));
    if (s[at++] != '/') bad();
    const Whole bottom = natural();
    if (at != s.size() || bottom.zero()) bad();
    return signed_as(Fraction(top, bottom));
}
